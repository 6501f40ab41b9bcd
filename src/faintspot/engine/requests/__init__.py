"""Requests to a running engine (`requests`), its child processes and priority (`child_processes`)."""
