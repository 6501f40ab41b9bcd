"""A night of observations that alternate between methods, simulated or recorded. Read in this order.

`blocks` (`Night`: one row for each block of frames), `protocol` and `simulated` (the night of Basden et al.
2015 in a simulated loop), `analysis` (differences with errors, hours for 3 sigma, verdicts), `paper` (Table 1
beside it) and `page` (Zarr, JSON and figures). `recorded`
makes a night of the engine's telemetry, with the page of `recorded_page`.
"""
