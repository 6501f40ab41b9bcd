"""Recorded frames: a configuration (`first_layout`), slopes in a file (`measuring`), and their page."""
