"""Loops that other packages simulate from the atmosphere to the mirror; see foreign_loops.py."""
