"""Slope pipeline. Read in this order.

`settings`, `plan` (tables computed before the first frame), `slope_pipeline`, `slopes` (results), `light`
(dark sub-apertures), `following` (stacks of images, and windows that follow their spots), `configuration`
(faintspot.toml).
"""
