import math
from dataclasses import replace

import numpy as np
import pytest
from tests.loop.control.frozen_flow import frozen_slopes

from faintspot.loop.turbulence.slope_covariance import SlopeTurbulence
from faintspot.loop.turbulence.strength import TurbulenceStrength, turbulence_strength

CELLS = np.argwhere(np.ones((6, 6)))
AIR = SlopeTurbulence(
    np.asarray(CELLS[:, ::-1] * 0.5, np.float64),
    0.5,
    1e-6,
    0.15,
    25.0,
    np.array([0.7, 0.3]),
    np.array([[8.0, 3.0], [-6.0, 14.0]]),
)
FRAMES = 4000


@pytest.fixture(scope="module")
def slopes() -> np.ndarray:
    """Slopes of 16 s, the first quarter and the third from another piece of turbulence."""
    rng = np.random.default_rng(3)
    return np.vstack([frozen_slopes(AIR, FRAMES // 4, 250.0, rng) for _ in range(4)])


def found(slopes: np.ndarray, **options: float) -> TurbulenceStrength:
    run = np.repeat(np.arange(4), FRAMES // 4)
    return turbulence_strength(slopes, np.zeros_like(slopes), run, AIR, **options)


@pytest.mark.slow
@pytest.mark.parametrize("noise_px", [0.0, 0.5])
def test_known_turbulence(slopes: np.ndarray, noise_px: float) -> None:
    """Within three errors; the noise has as much variance as the turbulence of a slope."""
    noise = noise_px * np.random.default_rng(4).standard_normal(slopes.shape)
    strength = found(slopes + noise)
    assert abs(strength.r0_m - AIR.r0_m) < 2 * strength.r0_error_m < 0.02
    assert abs(math.log(strength.outer_scale_m / 25)) < 1
    known = found(slopes + noise, outer_scale_m=25.0)
    assert known.outer_scale_m == pytest.approx(25)
    assert known.r0_error_m < strength.r0_error_m


def test_stronger_slopes(slopes: np.ndarray) -> None:
    """Twice the slopes: r0 is smaller by 2^(6/5)."""
    ratio = found(2 * slopes).r0_m / found(slopes).r0_m
    assert ratio == pytest.approx(2**-1.2, rel=1e-6)


def test_gain_error(slopes: np.ndarray) -> None:
    """An uncertain gain of residual slopes adds to the error."""
    run = np.repeat(np.arange(4), FRAMES // 4)
    sure, unsure = (
        turbulence_strength(slopes, 0.5 * slopes, run, AIR, gain_error=each) for each in (0.0, 0.1)
    )
    assert unsure.r0_error_m > sure.r0_error_m
    assert unsure.r0_m == pytest.approx(sure.r0_m, rel=0.05)


def test_noise_alone_and_two_subapertures(slopes: np.ndarray) -> None:
    alternating = np.tile([[1.0], [-1.0]], (FRAMES // 2, 72))
    assert math.isnan(found(alternating).r0_m)
    pair = replace(AIR, positions_m=AIR.positions_m[:2])
    both = slopes[:, [0, 1, 36, 37]]
    strength = turbulence_strength(both, np.zeros_like(both), np.repeat(np.arange(4), FRAMES // 4), pair)
    assert abs(strength.r0_m - AIR.r0_m) < 3 * strength.r0_error_m


@pytest.mark.parametrize("seed", range(6))
def test_noise_alone_has_no_strength(seed: int) -> None:
    noise = np.random.default_rng(seed).standard_normal((1200, 72))
    assert np.isnan(turbulence_strength(noise, noise, np.zeros(1200, np.int64), AIR).r0_m)
