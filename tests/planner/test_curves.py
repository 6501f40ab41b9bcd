from __future__ import annotations

import math

import numpy as np
import pytest

from faintspot.planner.curves import Curve, limiting_flux, magnitude_gain

FLUX = np.geomspace(10, 1000, 7)
RNG = np.random.default_rng(3)


def curve(flux_at_one_px: float, n: int = 2000) -> Curve:
    """R = sqrt(flux_at_one_px / flux), with 10 % of scatter that is the same for every curve."""
    scatter = 1 + 0.1 * np.random.default_rng(1).standard_normal((len(FLUX), n))
    scatter /= scatter.mean(axis=1, keepdims=True)
    return Curve(FLUX, np.sqrt(flux_at_one_px / FLUX)[:, None] * scatter)


def test_half_the_light_is_three_quarters_of_a_magnitude() -> None:
    gain = magnitude_gain(curve(10.0), curve(5.0), 3, RNG)
    assert gain.value == pytest.approx(2.5 * math.log10(2), abs=0.01)
    # The spots are the same, so nearly nothing is left of the scatter.
    assert gain.standard_error < 0.005


def test_no_gain_over_itself() -> None:
    plain = curve(10.0)
    assert magnitude_gain(plain, plain, 3, RNG).value == 0.0


@pytest.mark.parametrize(("light", "expected"), [(0.01, math.inf), (1e4, -math.inf)])
def test_gain_beyond_the_curve_has_a_sign(light: float, expected: float) -> None:
    assert magnitude_gain(curve(10.0), curve(light), 3, RNG).value == expected


def test_limiting_flux() -> None:
    limit = limiting_flux(curve(10.0), 0.5, RNG)
    assert limit.value == pytest.approx(40.0, rel=0.01)
    # 10 % of scatter over 2000 spots is 0.22 % of R, 0.45 % of the flux, less between two points.
    assert 0.05 < limit.standard_error < 0.25


def test_limit_beyond_the_curve() -> None:
    assert limiting_flux(curve(10.0), 0.01, RNG).value == math.inf
    assert limiting_flux(curve(10.0), 2.0, RNG).value == 0.0
