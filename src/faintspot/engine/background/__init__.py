"""Processes beside the engine that learn while it runs: `learning` (filters), `sodium` (spots of a laser)."""
