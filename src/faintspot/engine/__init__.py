"""Pixels -> commands in real time. Read in this order.

`pixels` (shared memory that a camera writes), `path` (rows of pixels to slopes), `streams` (what other
software reads), `settings` (what changes while it runs), `control_loop` and `guard` (slopes to commands),
`telemetry`, `engine` (all of it in one thread), `requests` (to it), `background` (processes that learn beside
it), `page` (its web page). `poking` moves a mirror for its calibration; `telescope` is a simulated one.
"""
