"""Processes beside the engine that learn while it runs."""
