"""Slopes as stored: the format, the writer that resumes, and one file for each kind of store."""
