"""Methods compared by the Strehl ratio of a simulated loop. Read in this order.

`methods` (what is compared, and what is tuned), `search` (tuning), `magnitude` and `budget` (the
experiments), `results` (files and comparisons), `verdict`, `tables`, `figures` and `page` (their report).
For the planner: `question`, `tuning`, `answer`, `text`.
"""
