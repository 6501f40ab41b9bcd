"""What the tests of all adapters share: spots without noise, and whether a tool is there."""

import importlib.util
from typing import Any

import numpy as np
import pytest

import faintspot as fs
from faintspot import Settings

SIDE, N = 10, 9
PSF = fs.PSF.analytic("gaussian", size=1.0)  # FWHM 2 px
READ_NOISE = fs.Calibration(read_noise_e=1.0)
FAINT_E = 40.0
POSITIONS = np.random.default_rng(5).uniform(-1.0, 1.0, (N, 2))
EVERYTHING = Settings("brightest", keep_brightest=SIDE * SIDE, rule="threshold")
"""A centre of gravity of all pixels, as most tools' own."""


def needs(package: str, extra: str) -> pytest.MarkDecorator:
    """Skip a test where a tool is absent."""
    absent = importlib.util.find_spec(package) is None
    return pytest.mark.skipif(absent, reason=f"{package} is not installed (extra {extra})")


def images(flux_e: float = 1000.0, positions: Any = POSITIONS) -> np.ndarray:
    """Return spots without noise, (n, SIDE, SIDE) electrons."""
    return np.asarray(PSF.images(np.asarray(positions), (SIDE, SIDE), flux_e))


def noisy(rng: np.random.Generator, flux_e: float = FAINT_E, positions: Any = POSITIONS) -> np.ndarray:
    """Return the same with photon noise and 1 electron of read noise."""
    clean = images(flux_e, positions)
    return np.asarray(rng.poisson(np.maximum(clean, 0.0)) + rng.normal(0.0, 1.0, clean.shape))


ESTIMATORS = {
    "brightest": Settings("brightest", keep_brightest=20),
    "tv": Settings("tv", noise_std=0.6, keep_brightest=20),
    "smoothed": Settings("smoothed", keep_brightest=20),
    "centroid": Settings("centroid"),
    "thresholded": Settings("thresholded", threshold_e=2.0),
    "window": Settings("window", flux_e=FAINT_E),
    "weighted": Settings("weighted"),
    "ml": Settings("ml", model_error=0.3),
    "map": Settings("map", flux_e=FAINT_E, prior_std_px=0.5),
}
"""All that need no training."""
