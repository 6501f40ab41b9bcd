"""Camera: `calibration`; its measurement (`dark_frames`, `photon_transfer`, `hot_pixels`); `detector`."""
