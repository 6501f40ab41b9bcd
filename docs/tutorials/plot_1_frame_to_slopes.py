"""
From a frame to slopes
======================

One frame of a sensor that faintspot has never seen: where are its lenslets, where are the spots, and what
is the wavefront? The frame is real: an on-sky exposure of the 6.5 m MMT's active optics (mmtwfs,
BSD-3-Clause), with faint spots, hot pixels and no dark.
"""

# %%
# Find the lenslets
# -----------------
# No hints are needed: neither pitch, nor angle, nor the shape of the pupil.

import numpy as np
from matplotlib.figure import Figure

import faintspot as fs
from faintspot.data import mmt_frame
from faintspot.slopes.camera.frame_checks import find_hot_pixels
from faintspot.slopes.sensor.found_layout import find_layout

frame = mmt_frame()
hot = find_hot_pixels(frame)
bad = np.zeros(frame.shape, bool)
bad[tuple(hot.T)] = True

found = find_layout(np.where(bad, np.median(frame), frame), bad_pixels=bad)
layout = found.layout
print(f"{len(layout)} sub-apertures, {layout.pitch_px:.2f} px apart, turned by {layout.angle_deg:.2f} deg")
print(f"{len(hot)} hot pixels")

# %%
figure = layout.plot(frame).figure

# %%
# Measure
# -------
# A `Calibration` describes the detector, `Settings` the estimator. There is no dark frame here, so the
# background of the frame replaces it; `estimated` says that it is approximate. The strength of the denoising
# is a noise level in electrons.

dark = float(np.median(frame))
calibration = fs.Calibration(dark=dark, estimated=("dark",), bad_pixels=hot)
denoised = fs.SlopePipeline(layout, fs.Settings("tv", noise_std=15.0, keep_brightest=30), calibration)
plain = fs.SlopePipeline(layout, fs.Settings("brightest", keep_brightest=30), calibration)

slopes = denoised(frame)
print(slopes)
figure = slopes.plot().figure

# %%
# One of the fainter sub-apertures, after every step:

stages = denoised.explain(frame)
which = int(np.argsort(slopes.flux)[len(layout) // 4])
steps = {
    "calibrated": stages.calibrated,
    "denoised": stages.denoised,
    "background subtracted": stages.background_subtracted,
}
figure = Figure(figsize=(9, 3.2), layout="constrained")
for axes, (title, images) in zip(figure.subplots(1, 3), steps.items(), strict=True):
    axes.imshow(images[which], cmap="cividis", origin="lower", vmin=-30, vmax=stages.denoised[which].max())
    axes.set(title=title, xlabel="px")

# %%
# The wavefront
# -------------
# Zernike modes in Noll's order, fitted to the slopes. Tip and tilt are left out of the picture; without a
# pixel scale in the layout, the unit is that of the slopes.

wavefront = fs.fit_wavefront(slopes, layout)
print(wavefront)
figure = wavefront.plot(tilt=False).figure

# %%
# On the command line the same is
#
# .. code-block:: sh
#
#    faintspot layout frame.npy -o faintspot.toml --mask-hot-pixels
#    faintspot slopes frame.npy --config faintspot.toml -o slopes.zarr
#    faintspot wavefront slopes.zarr
