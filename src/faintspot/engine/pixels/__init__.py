"""Pixels in shared memory: `segment` and `pixel_ring`, filled by `camera` (simulated) or `replay`."""
