"""Vibrations: lines in the spectra of tip, tilt and focus, told from broad maxima."""

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.loop.control.driven import driven, oscillator
from tests.patience import mostly_slow

from faintspot.loop.control.identification.vibrations import (
    MODES,
    Vibration,
    _errors,
    find_vibrations,
    without_passing_grid,
)

_RATE_HZ, _FRAMES, _SLOPES = 250.0, 3000, 72
BUMP = oscillator(17.5, 0.12, 0.08)
"""As wide as the maximum that a wind of 12 m/s makes with sub-apertures of .6 m on 3.6 m: 12 / 3.6 Hz."""
POSITIONS_M = np.asarray(0.6 * np.argwhere(np.ones((7, 7)))[:, ::-1], np.float64)
WIND = np.array([[3.0, 12.1]])


def _seen(seed: int, *moving: Vibration) -> NDArray[np.float64]:
    """Return amplitudes of the modes with white noise of rms 1, and oscillators in tilt."""
    rng = np.random.default_rng(seed)
    amplitudes = rng.standard_normal((_FRAMES, len(MODES)))
    amplitudes[:, 1] += driven(rng, _FRAMES, _RATE_HZ, _SLOPES, *moving)
    return amplitudes


@pytest.mark.parametrize("seed", mostly_slow(1, range(4)))
def test_a_broad_maximum_is_no_vibration(seed: int) -> None:
    assert find_vibrations(_seen(seed, BUMP), _RATE_HZ, _SLOPES) == ()


@pytest.mark.parametrize(
    ("frequency_hz", "damping"), mostly_slow(1, [(18.3, 0.002), (45.0, 0.005), (93.0, 0.006)])
)
def test_a_weak_line_beside_a_broad_maximum_is_found(frequency_hz: float, damping: float) -> None:
    true = oscillator(frequency_hz, damping, 0.07)
    (found,) = find_vibrations(_seen(3, BUMP, true), _RATE_HZ, _SLOPES)
    assert found.mode == "tilt"
    assert found.frequency_hz == pytest.approx(frequency_hz, abs=4 * found.frequency_error_hz)
    assert found.frequency_error_hz < 0.5
    # Driven at random for 12 s, its rms differs from the expected one by 15 %.
    assert found.rms_px == pytest.approx(true.rms_px, rel=0.4)


def test_errors_are_those_of_a_normal_distribution() -> None:
    covariance = np.array([[0.04, 0.01], [0.01, 0.09]])
    information, best = np.linalg.inv(covariance), np.array([3.0, -2.0])
    errors = _errors(lambda at: 0.5 * float((at - best) @ information @ (at - best)), best)
    np.testing.assert_allclose(errors, [0.2, 0.3], rtol=1e-6)


def _passing(*moving: Vibration) -> tuple[Vibration, ...]:
    """Return what is found in tilt while waves of 0.6 m pass over 7 sub-apertures of 0.6 m at 12.1 m/s."""
    rng, crossing = np.random.default_rng(2), round(4.2 / WIND[0, 1] * _RATE_HZ)
    waves = rng.standard_normal((2, _FRAMES + crossing - 1)).T @ [1.0, 1j]
    over_sensor = np.convolve(waves, np.full(crossing, crossing**-0.5), "valid")
    amplitudes = 0.4 * rng.standard_normal((_FRAMES, len(MODES)))
    amplitudes[:, 1] += (over_sensor * np.exp(2j * np.pi * 12.1 / 0.6 * np.arange(_FRAMES) / _RATE_HZ)).real
    amplitudes[:, 1] += driven(rng, _FRAMES, _RATE_HZ, 98, *moving)
    return find_vibrations(amplitudes, _RATE_HZ, 98)


def test_a_layer_that_passes_over_the_grid_is_no_vibration() -> None:
    found = _passing()
    assert [line.frequency_hz for line in found] == pytest.approx([20.2], abs=0.5)
    assert without_passing_grid(found, WIND, POSITIONS_M, 0.6, _RATE_HZ) == ()
    assert without_passing_grid(found, 1.2 * WIND, POSITIONS_M, 0.6, _RATE_HZ) == found
    assert without_passing_grid(found, WIND[:, ::-1], POSITIONS_M, 0.6, _RATE_HZ) == found


def test_a_vibration_at_the_frequency_of_the_grid_is_kept() -> None:
    found = _passing(oscillator(20.0, 0.004, 0.3))
    kept = without_passing_grid(found, WIND, POSITIONS_M, 0.6, _RATE_HZ)
    assert [line.frequency_hz for line in kept] == pytest.approx([20.0], abs=0.3)
