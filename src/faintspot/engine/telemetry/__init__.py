"""Telemetry of an engine: ring, recorder, report."""
