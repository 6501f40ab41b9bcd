"""Configuration of a simulated telescope: its sections, their limits, and the built-in files (`presets`)."""
