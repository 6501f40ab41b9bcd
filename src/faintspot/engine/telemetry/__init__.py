"""Telemetry of an engine: `ring` (shared memory) and `recorder`."""
