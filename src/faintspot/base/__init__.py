"""Errors, checks, files and statistics used by all other packages; begin with `errors` and `checks`."""

__version__ = "0.1.0"
