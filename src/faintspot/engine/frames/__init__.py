"""From rows of pixels to slopes. Read in this order.

`pixel_ring` (frames in shared memory), `readout`, `frame_path`, `python_path` (estimators in NumPy),
`workers` (threads), `timing` (latencies, and causes of late frames).
"""
