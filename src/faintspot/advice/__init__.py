"""Advice for a running loop: what its telemetry tells, what may be better, and whether it is."""
