"""Controllers learnt from open-loop slopes. Read in this order.

`vibrations` (narrow lines in the spectra of tip, tilt and focus), `slope_spectra` (slopes without gaps, and
spectra of frozen turbulence), `layer_likelihood` (their fit), `layers` (winds, noise and vibrations
together), `model` (what is learnt, and its file), `learning` (all of it, once and again, also from the
running loop). Of loops of other systems: `recording` (frames and their system), `preparation` (in one
convention), `loop_delay` (delay and centroid gain), `open_loop` (slopes without the mirror),
`misregistration` (of the mirror), `learnt_loop` (all of it), `predictive_control` (the controller). Of
sensors without geometry: `modal_delay` (modes of the interaction matrix; delay, gain and law), `modal_model`
(measured properties of a controlled loop, and predictors of the modes).
"""
