"""Report of recorded slopes: `page` shows a `run`, with `pictures`; `stored` makes one of files."""
