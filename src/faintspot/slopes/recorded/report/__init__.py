"""Report of recorded slopes: `page` shows a `run`, with pictures in `maps` and `frame_pictures`."""
