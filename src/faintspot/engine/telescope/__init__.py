"""The simulated telescope of an engine."""
