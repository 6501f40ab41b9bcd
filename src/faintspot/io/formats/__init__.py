"""File formats: `registry` lists them, then files for each kind; `io.file_format` is the interface."""
