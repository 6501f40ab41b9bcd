"""The simulated telescope. Read in this order.

`atmosphere`, `mirror` (and pupil) and `wavefront_sensor` (wavefronts and spots), `model` (one frame of all of
them), `calibration` (camera, interaction matrix and gains). With a laser guide star: `laser`.
"""
