"""Pixels in shared memory: `segment` and `pixel_ring`, filled by a `readout`, also of recorded frames."""
