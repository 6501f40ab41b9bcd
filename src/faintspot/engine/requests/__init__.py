"""Requests to a running engine, and processes."""
