"""
Learn the spot, and come near the bound
=======================================

A centre of gravity does not know what a spot looks like; maximum likelihood does. The point-spread function
(PSF) is learnt from the frames themselves, and the slope error is compared with the limit that no estimator
without bias can pass (Cramer and Rao).
"""

# %%
# Frames of 36 sub-apertures, 150 electrons a spot, 3 electrons of read noise. They are simulated, so that
# the truth is known; no estimator knows that the spot is elongated.

import numpy as np
from matplotlib.figure import Figure

import faintspot as fs

layout = fs.Layout.grid((7, 7), pixels=12, outer_radius=3.5, inner_radius=0.5)
shape = {"size": 1.3, "elongation": 1.5, "angle_deg": 30.0}
detector = fs.slopes.simulate.Detector(read_noise_e=3.0)
frames, truth = fs.slopes.simulate.sensor_frames(
    layout,
    600,
    flux_e=150.0,
    detector=detector,
    **shape,
    rng=np.random.default_rng(1),
)
calibration = fs.Calibration(dark=0.0, read_noise_e=3.0)

# %%
# Learn it from half of them, measure the other half.

learnt = fs.learn_psf(frames[:300], layout, calibration)
print(learnt)

figure = Figure(figsize=(10, 4), layout="constrained")
true = fs.PSF.analytic(**shape)
for axes, psf in zip(figure.subplots(1, 2), (true, learnt), strict=True):
    psf.plot(axes)

# %%
# Estimators, and how far each is from the bound
# ----------------------------------------------


def error(settings: fs.Settings, **knowledge: fs.PSF) -> float:
    """Return the mean slope error R, px."""
    slopes = fs.SlopePipeline(layout, settings, calibration, **knowledge)(frames[300:])
    return float(np.abs(np.stack([slopes.x, slopes.y], -1) - truth[300:]).mean())


# An estimator with normally distributed errors at the bound has R = sqrt(2 / pi) times its standard error.
bound = fs.cramer_rao(150.0, shape=(12, 12), psf=true, detector=detector, position_range_px=1.0)
found = {
    "brightest pixels": error(fs.Settings("brightest", keep_brightest=10)),
    "TV, brightest pixels": error(fs.Settings("tv", noise_std=3.0, keep_brightest=12)),
    "maximum likelihood, learnt PSF": error(fs.Settings("ml", search_range_px=2.0), psf=learnt),
    "maximum likelihood, true PSF": error(fs.Settings("ml", search_range_px=2.0), psf=true),
    "bound": float(np.sqrt(2 / np.pi) * bound.mean()),
}
for name, value in found.items():
    print(f"{name}: R = {value:.4f} px")

figure = Figure(figsize=(8, 3), layout="constrained")
axes = figure.add_subplot(xlabel="slope error R, px")
axes.barh(list(found), list(found.values()), color="#4477aa")
axes.invert_yaxis()

# %%
# `learnt.save("psf.npz")` keeps it. For `faintspot slopes`, name it in faintspot.toml: a table `[psf]` with
# `file = "psf.npz"`.
