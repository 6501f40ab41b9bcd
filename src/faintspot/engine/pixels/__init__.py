"""Pixels in shared memory: `segment` and `pixel_ring`, filled by a `readout`, such as `replay`."""
