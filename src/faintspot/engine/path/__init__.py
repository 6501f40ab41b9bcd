"""One frame's path: from rows of pixels to slopes, on worker threads."""
