"""White noise of slopes in frozen turbulence, against the noise that was put in."""

from functools import lru_cache
from typing import Any

import numpy as np
import pytest
from tests.loop.control.frozen_flow import frozen_slopes
from tests.patience import mostly_slow

from faintspot.loop.control.identification.slope_noise import noise_of_slopes
from faintspot.loop.slope_covariance import ARCSEC, SlopeTurbulence

CELLS, NOISE_PX = np.argwhere(np.ones((4, 4))), 0.05
SPEEDS = {"slow": (4.0, 1.0), "fast": (8.0, 4.0)}  # m/s: .09 and .19 sub-apertures a frame


@lru_cache
def turbulence(speed: str) -> Any:
    """Return slopes of 0.5 px rms, of one frozen layer over sub-apertures of 0.24 m at 200 Hz."""
    wind = np.array([SPEEDS[speed]])
    air = SlopeTurbulence(
        np.asarray(0.24 * CELLS[:, ::-1], np.float64), 0.24, 0.5 * ARCSEC, 0.12, 20.0, np.ones(1), wind
    )
    return frozen_slopes(air, 1200, 200.0, np.random.default_rng(5))


def noisy(speed: str, noise: Any = NOISE_PX) -> Any:
    slopes = turbulence(speed)
    return slopes + noise * np.random.default_rng(6).standard_normal(slopes.shape)


def within(slopes: Any, noise: float = NOISE_PX) -> float:
    """Return the deviation of the measured noise, in standard errors."""
    found = noise_of_slopes(slopes)
    rms = float(np.sqrt(np.nanmean(found.variance)))
    return (rms / noise - 1) / (0.5 * found.shared_error)


@pytest.mark.parametrize("speed", mostly_slow(1, SPEEDS))
@pytest.mark.parametrize("noise", [0.05, 0.2])
def test_turbulence_is_not_taken_for_noise(speed: str, noise: float) -> None:
    """Within 2.6 standard errors of at most 12 %; a parabola in time gives 0.06 px for 0.05 px."""
    slopes = noisy(speed, noise)
    assert abs(within(slopes, noise)) < 2.6
    assert noise_of_slopes(slopes).shared_error < 0.24


def test_noise_below_fast_turbulence_is_not_known() -> None:
    """Ten times weaker than what the turbulence changes from frame to frame."""
    assert noise_of_slopes(noisy("fast", 0.002)).shared_error > 0.5


def test_gaps_do_not_matter() -> None:
    """5 % of the frames, and a sub-aperture for half of the time."""
    slopes = noisy("slow")
    slopes[np.random.default_rng(1).random(len(slopes)) < 0.05] = np.nan
    slopes[:600, [3, 19]] = np.nan
    slopes[:, [7, 23]] = np.nan
    found = noise_of_slopes(slopes)
    assert abs(within(slopes)) < 2.6
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(found.error)), [7, 23])


def test_one_row_in_three_is_missing() -> None:
    slopes = noisy("slow", 0.2)
    slopes[::3] = np.nan
    assert abs(within(slopes, 0.2)) < 2.6


def test_slopes_have_their_own_noise() -> None:
    """Half of the slopes with twice the noise: each within 15 %, three of its errors."""
    noise = np.where(np.arange(32) % 2, 0.1, 0.2)
    found = noise_of_slopes(noisy("slow", noise))
    np.testing.assert_allclose(np.sqrt(found.variance), noise, rtol=0.15)


def test_too_few_frames_have_no_known_shared_error() -> None:
    """So the noise is an upper limit."""
    found = noise_of_slopes(noisy("slow")[:40])
    assert np.isnan(found.shared_error)
    assert np.sqrt(found.variance.mean()) > 0.9 * NOISE_PX
