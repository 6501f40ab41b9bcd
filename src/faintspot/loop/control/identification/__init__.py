"""Controllers learnt from open-loop slopes. Read in this order.

`slope_records` (slopes without gaps), `vibrations` and `oscillators` (narrow lines in the spectra of tip,
tilt and focus), `slope_spectra` (spectra of frozen turbulence), `layer_likelihood` (their fit), `layers`
(winds, noise and vibrations together), `replay` (residual of a controller on recorded slopes), `model`
(what is learnt, and its file), `learning` and `relearning` (all of it). Of loops of other systems:
`recording` (slopes and commands), `cell_order` (of their sub-apertures), `loop_delay` (delay and centroid
gain), `open_loop` (slopes without the mirror), `measured` (values with errors), `predictive_control` (all of
it).
"""
