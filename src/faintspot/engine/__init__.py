"""Pixels -> commands in real time. Read in this order.

`processes` (shared memory, child processes, requests), `frames` (from rows of pixels to slopes), `streams`
(what other software reads or writes), `settings` (what changes while the engine runs), `control` (from slopes
to commands), `telemetry`, `engine` (all of it in one thread), `request_handlers`, `background` (learning
beside it), `page` (its web page), `telescope` (a simulated one).
"""
