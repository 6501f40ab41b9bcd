"""Report of recorded slopes: `page` is made of `sections`, whose numbers are in `key_numbers` and `maps`."""
