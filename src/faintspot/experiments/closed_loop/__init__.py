"""Methods compared by the Strehl ratio of a simulated loop. Read in this order.

`methods` (what is compared, and what is tuned), `search` (tuning), `magnitude` (tunes and
scores at every flux), `results` (files and comparisons), `verdict` and `page` (their report).
"""
