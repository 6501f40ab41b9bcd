"""Correlation with a reference image: against a direct search, on elongated spots and extended sources."""

from typing import Any

import numpy as np
import pytest
from scipy.optimize import minimize

import faintspot as fs
from faintspot.slopes.estimators.built_in.correlation import Correlation

SIDE, N = 12, 6
PSF = fs.PSF.analytic(
    "gaussian", size=1.2, elongation=np.linspace(1.0, 2.5, N), angle_deg=30.0 * np.arange(N), index=range(N)
)
TRUTH = np.random.default_rng(1).uniform(-1.2, 1.2, (N, 2))
IMAGES = PSF.images(TRUTH, (SIDE, SIDE), 1000.0, which=range(N))


def measured(images: Any, psf: fs.PSF, **options: Any) -> Any:
    settings = fs.Settings(Correlation(**options), search_range_px=2.5)
    slopes = fs.measure_images(images, settings, psf=psf)
    assert slopes.valid.all()
    return np.stack([slopes.x, slopes.y], axis=1)


@pytest.mark.parametrize(("step_px", "tolerance_px"), [(1.0, 0.15), (0.5, 0.05), (0.1, 0.005)])
def test_the_interpolation_is_better_the_closer_the_steps(step_px: float, tolerance_px: float) -> None:
    # The peak of a correlation of spots about 3 px wide, cut by the window.
    assert np.abs(measured(IMAGES, PSF, step_px=step_px) - TRUTH).max() < tolerance_px


def test_the_maximum_is_that_of_a_direct_search() -> None:
    noisy = np.random.default_rng(2).poisson(0.2 * IMAGES).astype(float)
    found = measured(noisy, PSF, step_px=0.1)
    for s in range(N):

        def negative(place: Any, s: int = s) -> float:
            reference = PSF.images([place], (SIDE, SIDE), which=s)[0]
            return -float((noisy[s] * reference).sum() / np.sqrt(np.square(reference).sum()))

        best = minimize(negative, found[s], method="Nelder-Mead", options={"xatol": 1e-4}).x
        np.testing.assert_allclose(found[s], best, atol=0.02)


def test_an_extended_source_is_followed() -> None:
    rng = np.random.default_rng(3)
    scene = np.kron(rng.uniform(0.0, 1.0, (9, 9)), np.ones((5, 5)))
    extended = fs.PSF(scene, 2).blurred(0.8)
    moved = extended.images(TRUTH, (16, 16), 5000.0)
    # It is larger than the window.
    assert np.abs(measured(moved, extended, step_px=0.5, local_background="on") - TRUTH).max() < 0.05
