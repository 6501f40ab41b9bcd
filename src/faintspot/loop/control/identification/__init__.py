"""Controllers learnt from open-loop slopes. Read in this order.

`slope_records` (slopes without gaps), `vibrations` and `oscillators` (narrow lines in the spectra of tip,
tilt and focus), `slope_spectra` (spectra of frozen turbulence), `layer_likelihood` (their fit), `layers`
(winds, noise and vibrations together), `replay` (residual of a controller on recorded slopes), `model`
(what is learnt, and its file), `learning` and `relearning` (all of it). `loop_delay` measures delay and
centroid gain.
"""
