"""Vibrations: lines in the spectra of tip, tilt and focus, told from broad maxima."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from faintspot.control.vibrations import MODES, Vibration, find_vibrations

_RATE_HZ, _FRAMES, _SLOPES = 250.0, 3000, 72


def _series(seed: int, *driven: Vibration) -> NDArray[np.float64]:
    """Return the amplitude of a mode: white noise of rms 1 and oscillators."""
    rng = np.random.default_rng(seed)
    total = rng.standard_normal(_FRAMES)
    for each in driven:
        one, two = each.recursion(_RATE_HZ)
        driving = np.sqrt(_SLOPES * each.driving_variance(_RATE_HZ)) * each.rms_px
        values = [0.0, 0.0]
        for noise in driving * rng.standard_normal(_FRAMES + 1000):
            values.append(one * values[-1] + two * values[-2] + noise)
        total += values[-_FRAMES:]
    return total


def _oscillator(frequency_hz: float, damping: float, rms_px: float) -> Vibration:
    return Vibration("tip", frequency_hz, damping, rms_px, 0.0, 0.0)


BUMP = _oscillator(17.5, 0.12, 0.08)
"""As wide as the maximum that a wind of 12 m/s makes with sub-apertures of .6 m on 3.6 m: 12 / 3.6 Hz."""


@pytest.mark.parametrize("seed", range(4))
def test_a_broad_maximum_is_no_vibration(seed: int) -> None:
    quiet = np.random.default_rng(100 + seed).standard_normal((2, _FRAMES))
    amplitudes = np.column_stack([_series(seed, BUMP), *quiet])
    assert find_vibrations(amplitudes, _RATE_HZ, _SLOPES) == ()


@pytest.mark.parametrize(("frequency_hz", "damping"), [(18.3, 0.002), (45.0, 0.005), (93.0, 0.006)])
def test_a_weak_line_beside_a_broad_maximum_is_found(frequency_hz: float, damping: float) -> None:
    true = _oscillator(frequency_hz, damping, 0.07)
    quiet = np.random.default_rng(9).standard_normal((2, _FRAMES))
    amplitudes = np.column_stack([quiet[0], _series(3, BUMP, true), quiet[1]])
    (found,) = find_vibrations(amplitudes, _RATE_HZ, _SLOPES)
    assert found.mode == MODES[1]
    assert found.frequency_hz == pytest.approx(frequency_hz, abs=4 * found.frequency_error_hz)
    assert found.frequency_error_hz < 0.5
    # Driven at random for 12 s, its rms differs from the expected one by 15 %.
    assert found.rms_px == pytest.approx(true.rms_px, rel=0.4)
