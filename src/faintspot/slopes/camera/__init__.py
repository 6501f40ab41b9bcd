"""Camera: `calibration`, `detector`, and their measurement.

`dark_frames`, `photon_transfer` and `transfer_curve` measure the detector; `frame_checks`, `background` and
`fitting_dark` look at frames of spots.
"""
