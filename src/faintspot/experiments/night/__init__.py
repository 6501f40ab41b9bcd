"""A night of observations that alternate between methods, simulated or recorded. Read in this order.

`protocol` (the night of Basden et al. 2015; `Night`: one row for each block of frames), `simulated` (that
night in a simulated loop), `analysis` (differences with errors, hours for 3 sigma, verdicts), `paper` (Table
1 beside it) and `page` (Zarr, JSON and figures). `recorded` makes a night of the engine's telemetry, with its
page.
"""
