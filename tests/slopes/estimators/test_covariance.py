"""The stated 2 x 2 covariance of a slope's error, for elongated and rotated spots of a laser guide star."""

from typing import Any

import numpy as np
import pytest
from tests.patience import mostly_slow

import faintspot as fs

SIDE = (10, 10)
FRAMES = 300
MOTION_PX = 0.2
CALIBRATION = fs.Calibration(read_noise_e=1.0)
OF_95_PERCENT = 5.991
"""Squared Mahalanobis distance within which 95 % of a normal distribution in the plane lie."""


def star() -> fs.LaserGuideStar:
    """Sub-apertures all around a launch telescope, elongated by up to 2.6 px."""
    angle = 2 * np.pi * np.arange(12) / 12 + 0.1
    places = 6.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    spot = fs.PSF.analytic("gaussian", size=1.0)
    return fs.LaserGuideStar(places, [0.0, 0.0], pixel_arcsec=0.5, spot=spot)


STAR = star()
PSF = STAR.psf(STAR.focused(fs.SodiumProfile.peaks([86e3, 95e3], [4e3, 3e3], [0.6, 0.4])), radius_px=8)
LAYOUT = fs.Layout.grid((1, len(STAR)), pixels=SIDE[0])


def distances(slopes: fs.Slopes, truth: Any) -> Any:
    """Return squared Mahalanobis distances of the true positions from the measured ones."""
    errors = np.stack([slopes.x - truth[..., 0], slopes.y - truth[..., 1]], axis=-1)
    stated = np.empty((*slopes.x.shape, 2, 2))
    stated[..., 0, 0] = slopes.standard_error_x.astype(float) ** 2
    stated[..., 1, 1] = slopes.standard_error_y.astype(float) ** 2
    stated[..., 0, 1] = stated[..., 1, 0] = slopes.covariance_xy
    return np.einsum("fsi,fsij,fsj->fs", errors, np.linalg.inv(stated), errors)


@pytest.mark.parametrize("flux", [120.0, 1000.0])
@pytest.mark.parametrize("name", mostly_slow(1, ["ml", "map", "filter", "shape"]))
def test_ellipses_hold_95_percent(name: str, flux: float) -> None:
    """Within 2 %: the scatter of 3600 spots is 0.4 %; the rest is what a normal distribution neglects."""
    frames, truth = fs.slopes.simulate.sensor_frames(
        LAYOUT, FRAMES, flux_e=flux, psf=PSF,
        positions=np.random.default_rng(2).normal(0.0, MOTION_PX, (FRAMES, len(STAR), 2)),
        detector=fs.slopes.simulate.Detector(1.0), rng=np.random.default_rng(3),
    )  # fmt: skip
    window = fs.Settings("window", flux_e=flux)
    settings, score = {
        "ml": (fs.Settings("ml", search_range_px=2.0), None),
        "map": (fs.Settings("map", flux_e=flux, prior_std_px=MOTION_PX), None),
        "filter": (window, fs.FixedWeights.matched(PSF, SIDE, flux_e=flux, read_noise_e=1.0)),
        "shape": (window, fs.FixedWeights.shaped(PSF, SIDE)),
    }[name]
    slopes = fs.SlopePipeline(LAYOUT, settings, CALIBRATION, psf=PSF, weights=score)(frames)
    assert slopes.measured.all()
    assert slopes.valid.mean() > 0.97, slopes.valid.mean()
    found = distances(slopes, truth)
    assert 0.93 < np.mean(found < OF_95_PERCENT) < 0.97
    correlation = slopes.covariance_xy / (slopes.standard_error_x * slopes.standard_error_y)
    elongation = STAR.elongation_px(fs.SodiumProfile.gaussian())
    expected = np.sign(elongation.prod(axis=1))
    assert np.all(correlation.mean(axis=0) * expected > 0.05)  # least where the elongation is along an axis
