"""Slope pipeline. Read in this order.

`settings`, `plan` (tables computed before the first frame), `slope_pipeline`, `slopes` (results), `images`
(stacks of images), `configuration` (faintspot.toml), `mean_flux`; `labelled` (slopes for other packages).
"""
