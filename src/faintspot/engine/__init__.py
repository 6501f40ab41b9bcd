"""Pixels -> commands in real time. Read in this order.

Pixels in shared memory: `segment`, `pixel_ring`, `readout`. From rows of pixels to slopes: `frame_path`,
`workers`, `python_path` (estimators in NumPy), `timing`. `streams` (what other software reads or writes).
What changes while it runs: `interleaving` (configurations in turn), `running_settings`, `plan` (settings
prepared for a frame; running means of flux and dark windows), `estimators` (files of the user). From slopes
to commands: `control_loop`, `guard`. `telemetry`, `engine` (all of it in one thread), `requests` (to it)
and `request_handlers`, `child_processes`, `background` (learning beside it), `page` (its web page).
`poking` moves a mirror for its calibration; `telescope` is a simulated one.
"""
