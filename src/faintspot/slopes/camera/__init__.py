"""Camera: `calibration`, `detector`, and their measurement.

`dark_frames` and `photon_transfer` measure the detector; `hot_pixels`, `background` and `colour_mosaic`
look at frames of spots.
"""
