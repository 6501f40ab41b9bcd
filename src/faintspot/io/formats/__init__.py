"""File formats, found by `io.frames`: one module for each kind; `io.file_format` is the interface."""
