"""Pixels in shared memory: the ring, its segments, the simulated camera, replay."""
