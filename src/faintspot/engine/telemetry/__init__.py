"""Telemetry of an engine: `segment` and `ring` (shared memory), `recorder`, and the report (`page`)."""
