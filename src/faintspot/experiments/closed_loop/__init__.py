"""Methods compared by the Strehl ratio of a simulated loop. Read in this order.

`results` (what is compared and tuned; files and comparisons), `search` (tuning), `magnitude` (tunes and
scores at every flux), `verdict` (the report).
"""
