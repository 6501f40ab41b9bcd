"""Pixels in shared memory: `pixel_segment` and `pixel_ring`, filled by `camera` (simulated) or `replay`."""
