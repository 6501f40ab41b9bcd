"""Errors, checks, files and statistics used by all other packages; begin with `errors` and `checks`."""
