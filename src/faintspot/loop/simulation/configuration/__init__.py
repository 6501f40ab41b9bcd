"""The configuration of a simulated telescope, and those that are built in."""
