"""Processes beside the engine that learn filters while it runs."""
