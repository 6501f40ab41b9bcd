"""Errors, checks and files used by all other packages."""
