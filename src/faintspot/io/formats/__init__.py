"""File formats: `registry` lists them, `file_format` is the interface, then one file for each."""
