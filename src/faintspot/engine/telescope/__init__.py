"""Simulated telescope that publishes frames and reads commands, and its changing conditions."""
