"""Camera: `calibration`, `detector`, and their measurement.

`dark_frames`, `photon_transfer` and `transfer_curve` measure the detector; `frame_checks` looks at
frames of spots.
"""
