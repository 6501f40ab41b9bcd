"""Vibrations: lines in the spectra of tip, tilt and focus, told from broad maxima."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.loop.control.driven import driven, oscillator

from faintspot.loop.control.identification.vibrations import MODES, Vibration, find_vibrations

_RATE_HZ, _FRAMES, _SLOPES = 250.0, 3000, 72
BUMP = oscillator(17.5, 0.12, 0.08)
"""As wide as the maximum that a wind of 12 m/s makes with sub-apertures of .6 m on 3.6 m: 12 / 3.6 Hz."""


def _seen(seed: int, *moving: Vibration) -> NDArray[np.float64]:
    """Return amplitudes of the modes with white noise of rms 1, and oscillators in tilt."""
    rng = np.random.default_rng(seed)
    amplitudes = rng.standard_normal((_FRAMES, len(MODES)))
    amplitudes[:, 1] += driven(rng, _FRAMES, _RATE_HZ, _SLOPES, *moving)
    return amplitudes


@pytest.mark.parametrize("seed", range(4))
def test_a_broad_maximum_is_no_vibration(seed: int) -> None:
    assert find_vibrations(_seen(seed, BUMP), _RATE_HZ, _SLOPES) == ()


@pytest.mark.parametrize(("frequency_hz", "damping"), [(18.3, 0.002), (45.0, 0.005), (93.0, 0.006)])
def test_a_weak_line_beside_a_broad_maximum_is_found(frequency_hz: float, damping: float) -> None:
    true = oscillator(frequency_hz, damping, 0.07)
    (found,) = find_vibrations(_seen(3, BUMP, true), _RATE_HZ, _SLOPES)
    assert found.mode == "tilt"
    assert found.frequency_hz == pytest.approx(frequency_hz, abs=4 * found.frequency_error_hz)
    assert found.frequency_error_hz < 0.5
    # Driven at random for 12 s, its rms differs from the expected one by 15 %.
    assert found.rms_px == pytest.approx(true.rms_px, rel=0.4)
