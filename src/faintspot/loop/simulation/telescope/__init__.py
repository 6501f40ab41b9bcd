"""The simulated telescope. Read in this order.

`pupil`, `atmosphere`, `mirror` and `wavefront_sensor` (wavefronts and spots), `camera`, `model` (one frame of
all of them), `calibration` (interaction matrix and gains). With a laser: `laser`, `sodium`, `natural_star`.
"""
