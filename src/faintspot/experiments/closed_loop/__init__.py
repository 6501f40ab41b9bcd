"""Methods compared by the Strehl ratio of a simulated loop. Read in this order.

`methods` (what is compared, and what is tuned), `search` (tuning), `experiment` (tunes and scores),
`magnitude` (Strehl ratio against the star), `results` (files and comparisons), `verdict` and `page` (their
report).
"""
