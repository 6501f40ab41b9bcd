"""The part of slopes that no wavefront can cause."""

from dataclasses import replace

import numpy as np
import pytest
from tests.refusals import refused
from tests.slopes.wavefront.test_fit import LAYOUT, slopes_of, slopes_of_modes

from faintspot import Layout
from faintspot.slopes.wavefront import slope_discrepancy


def test_second_order_wavefronts_have_none() -> None:
    """Their mean gradients are exactly those of the phases at the corners."""
    coefficients = np.random.default_rng(1).normal(size=(20, 5))
    found = slope_discrepancy(slopes_of(slopes_of_modes(LAYOUT, coefficients)), LAYOUT)
    assert found.rms_px.max() < 1e-6  # float32 slopes
    assert np.isnan(found.expected_px).all()
    assert found.degrees_of_freedom == 22  # 72 slopes, 52 corners less piston and waffle


def test_noise_gives_what_the_standard_errors_say() -> None:
    noise = np.random.default_rng(2).normal(0.0, 0.3, (400, 2, len(LAYOUT)))
    found = slope_discrepancy(slopes_of(noise, error=0.3), LAYOUT)
    assert found.ratio == pytest.approx(1.0, abs=0.03)  # 400 frames with 22 degrees of freedom: 0.75 %


def test_gains_that_differ_show() -> None:
    rng = np.random.default_rng(3)
    slopes = slopes_of_modes(LAYOUT, rng.normal(0.0, 2.0, (100, 5)))
    slopes[:, 0] *= 1.2
    noisy = slopes + rng.normal(0.0, 0.1, slopes.shape)
    assert slope_discrepancy(slopes_of(noisy, error=0.1), LAYOUT).ratio > 1.3


def test_what_is_refused() -> None:
    slopes = slopes_of(np.zeros((1, 2, len(LAYOUT))))
    with refused("4 sub-apertures"):
        slope_discrepancy(slopes, Layout.grid((2, 2), pixels=8))
    with refused("geometry"):
        slope_discrepancy(slopes, replace(LAYOUT, geometry="hexagonal"))
    with refused("slopes", "discrepancy"):
        slope_discrepancy(slopes_of(np.zeros((1, 2, 1))), Layout.grid((1, 1), pixels=8))
