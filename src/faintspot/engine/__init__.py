"""Pixels -> commands in real time. Read in this order.

`pixels` (shared memory that a camera writes), `path` (rows of pixels to slopes), `streams` (what other
software reads), `settings` (what changes while it runs), `loop` (slopes to commands), `telemetry`,
`engine` (all of it in one thread), `background` (processes that learn beside it), `page` (its web page).
"""
