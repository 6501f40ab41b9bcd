"""
Spots of a laser guide star
===========================

The sodium layer is ten kilometres deep, so that a sub-aperture far from the launch telescope sees a line.
This page makes such spots, measures them, and learns the layer from the frames.
"""

# %%
# A sensor of 10 x 10 sub-apertures on a telescope of 8 m, with the laser at its left edge. The layer has two
# peaks. `focused` puts the mean altitude at the focus of the sensor.

from dataclasses import replace

import numpy as np
from matplotlib.figure import Figure

import faintspot as fs
from faintspot.slopes.training import MeanImages, fit_sodium_profile

rng = np.random.default_rng(1)
line = (np.arange(10) - 4.5) * 0.8
places = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
star = fs.LaserGuideStar(
    places,
    [-5.0, 0.0],
    pixel_arcsec=0.5,
    spot=fs.PSF.analytic("gaussian", size=0.9),
    zenith_distance_deg=30.0,
)
profile = star.focused(fs.SodiumProfile.peaks([86e3, 95e3], [4e3, 3e3], [0.6, 0.4]))
length = np.hypot(*star.elongation_px(profile).T)
print(f"elongation {length.min():.1f} to {length.max():.1f} px")

# %%
# Frames
# ------
# 300 frames of 200 electrons in a spot, with 1 electron of read noise.

layout = fs.Layout.grid((10, 10), pixels=10)
camera = fs.slopes.simulate.Detector(1.0)
psf = star.psf(profile)
frames, truth = fs.slopes.simulate.sensor_frames(
    layout,
    300,
    flux_e=200.0,
    psf=psf,
    positions=rng.normal(0.0, 0.2, (300, len(layout), 2)),
    detector=camera,
    rng=rng,
)
figure = Figure(figsize=(6, 5.4), layout="constrained")
axes = figure.add_subplot(xlabel="column, px", ylabel="row, px")
figure.colorbar(axes.imshow(frames[0], cmap="cividis", origin="lower"), label="ADU", shrink=0.8)

# %%
# Learn the layer
# ---------------
# All sub-apertures see the same profile. Begin with a single layer and fit it to the mean images; in a loop,
# do so every few seconds.

mean = MeanImages(layout.images(frames), np.zeros((300, len(layout), 2)))
start = star.focused(fs.SodiumProfile.gaussian()).at(np.linspace(76e3, 104e3, 41))
blurred = replace(star, spot=star.spot.blurred(0.2))  # by the motion of the spots
fit = fit_sodium_profile(mean, blurred, start, dark_variance_e2=1.0)

figure = Figure(figsize=(6, 3.6), layout="constrained")
axes = figure.add_subplot(xlabel="altitude, km", ylabel="density, 1/km")
for name, each in (("true", profile), ("start", start), ("learnt", fit.profile)):
    axes.plot(each.altitudes_m / 1e3, 1e3 * each.density, label=name)
axes.legend()

# %%
# Measure
# -------
# The linear matched filter of the learnt profile, that of the single layer, and a centre of gravity with a
# fixed window, each with the residual of its own gain and offset, as a loop calibrates them.

calibration = fs.Calibration(read_noise_e=1.0)
settings = fs.Settings("window", flux_e=200.0, window_fwhm_px=5.0)  # replaced by weights that are given


def error_px(weights: fs.FixedWeights | None, spots: fs.PSF) -> float:
    """Return the rms error of the slopes in px."""
    slopes = fs.SlopePipeline(layout, settings, calibration, psf=spots, weights=weights)(frames)
    found = np.stack([slopes.x, slopes.y], axis=-1)
    found = (found - found.mean(axis=0)) * truth.var() / np.mean(found * truth)
    return float((found - truth + truth.mean(axis=0)).std())


learnt, single = (blurred.psf(each, radius_px=8) for each in (fit.profile, start))
filters = [
    fs.FixedWeights.matched(each, layout.window, flux_e=200.0, read_noise_e=1.0) for each in (learnt, single)
]
print(f"window               {error_px(None, learnt):.3f} px")
print(f"filter, single layer {error_px(filters[1], single):.3f} px")
print(f"filter, learnt       {error_px(filters[0], learnt):.3f} px")
bound = fs.cramer_rao_covariance(200.0, psf, layout.window, detector=camera)
print(f"Cramer-Rao bound     {np.sqrt(np.trace(bound, axis1=1, axis2=2).mean() / 2):.3f} px")

# %%
# Gains and what limits them: :doc:`/results/laser_guide_stars`.
