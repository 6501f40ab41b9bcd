"""Slope pipeline. Read in this order.

`settings`, `plan` (tables computed before the first frame), `slope_pipeline`, `slopes` (results), `images`
(stacks of images), `following` (windows that follow their spots), `configuration` (faintspot.toml),
`mean_flux`; `labelled` (slopes for other packages).
"""
