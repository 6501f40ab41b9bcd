"""Controllers learnt from open-loop slopes. Read in this order.

`vibrations` (narrow lines in the spectra of tip, tilt and focus), `slope_spectra` (slopes without gaps, and
spectra of frozen turbulence), `layer_likelihood` (their fit), `layers` (winds, noise and vibrations
together), `model` (what is learnt, and its file), `learning` (all of it, once and again). Of loops of other
systems: `recording` (slopes and commands), `cell_order` (of their sub-apertures), `loop_delay` (delay and
centroid gain), `open_loop` (slopes without the mirror), `controlled_loop` (measured properties),
`misregistration` (of the mirror), `relearning` (frames of the running loop, and a process that learns from
them), `learnt_loop` (all of it), `predictive_control` (the controller). Of sensors without geometry:
`modal_loop` (modes of the interaction matrix), `modal_delay` (delay, gain and law), `modal_model`
(predictors of the modes).
"""
