"""The slope pipeline: settings, plan and slopes."""
