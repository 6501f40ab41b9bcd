"""Measurements from the telemetry of loops. Read in this order.

`recorded_loop` (a loop of any system from its file), `open_loop` (slopes without the mirror), `spectra`,
`slope_discrepancy`, `measured` (values with errors), `choices` (other controllers by replay),
`report`, `page`. `recording` prepares telemetry of this engine for learning. Of methods that alternated,
`alternation` gives the residual phase of each turn, and `relative_gains` their centroid gains.
"""
