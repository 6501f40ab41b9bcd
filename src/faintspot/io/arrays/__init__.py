"""Arrays in files, read in parts: raw bytes, FITS units, compressed data, Zarr stores."""
