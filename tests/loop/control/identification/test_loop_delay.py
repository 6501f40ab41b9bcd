"""Delay and centroid gain of a loop, from its slopes and commands."""

from __future__ import annotations

import numpy as np
import pytest
from tests.loop.telemetry.loop_cases import AIR, RATE_HZ, recorded

from faintspot.base.errors import InputError
from faintspot.loop.control.identification.loop_delay import DelayFits, LoopDelay


def found(delay: int, gain: float, given: float | None = None, frames: int | None = None) -> LoopDelay:
    loop = recorded(delay, gain)
    assert loop.commands is not None
    assert loop.interaction_matrix is not None
    held = loop.commands @ loop.interaction_matrix.T
    run = np.zeros(len(held), np.int64)
    fits = DelayFits(loop.slopes[:frames], held[:frames], run[:frames], AIR, RATE_HZ)
    return fits.best() if given is None else fits.of(given)


@pytest.mark.slow
@pytest.mark.parametrize("delay", [2, 3])
def test_delay(delay: int) -> None:
    """Within three of its errors, which ten seconds at this noise make 0.1 frames."""
    seen = found(delay, 1.0)
    assert seen.delay_error < 0.25
    assert abs(seen.delay_frames - delay) < 3 * seen.delay_error


@pytest.mark.slow
@pytest.mark.parametrize("gain", [0.8, 1.0])
def test_gain_for_a_known_delay(gain: float) -> None:
    seen = found(2, gain, given=2.0)
    assert seen.delay_frames == 2.0
    assert seen.gain_error < 0.06
    assert abs(seen.gain - gain) < 3 * seen.gain_error


def test_too_few_frames() -> None:
    with pytest.raises(InputError, match="expected 576 consecutive frames, got 300"):
        found(2, 1.0, frames=300)
