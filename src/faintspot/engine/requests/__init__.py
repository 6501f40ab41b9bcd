"""Requests to a running engine (`requests`), its priority (`scheduling`) and its child processes."""
