"""Arrays in files, read in parts: `stored_array` is the interface; FITS headers, streams and Zarr stores."""
