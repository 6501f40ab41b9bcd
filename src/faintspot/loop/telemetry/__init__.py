"""Measurements from the telemetry of running or recorded loops."""
