"""Advice for a running loop: measurements from its telemetry, possible improvements, and their tests."""
