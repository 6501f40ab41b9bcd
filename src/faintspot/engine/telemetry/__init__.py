"""Telemetry of an engine: `ring` (shared memory), `recorder`, `numbers` and the report (`page`)."""
