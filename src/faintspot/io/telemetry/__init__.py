"""Recorded telemetry: our own recordings, and AOT files."""
