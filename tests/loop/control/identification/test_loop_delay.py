"""Delay and centroid gain of a loop, from its slopes and commands."""

from __future__ import annotations

import numpy as np
import pytest
from tests.loop.control.control_cases import FRAME_S, INTERACTION, LAYERS, PLANT, TURBULENCE, telemetry
from tests.loop.telemetry.loop_cases import AIR, RATE_HZ, recorded

from faintspot.base.errors import InputError
from faintspot.loop.control.identification.loop_delay import DelayFits, LoopDelay, with_axes


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


@pytest.mark.slow
@pytest.mark.parametrize(("of_x", "of_y"), [(0.4, 0.6), (0.6, 0.4), (0.5, 0.5)])
def test_gains_of_x_and_y(of_x: float, of_y: float) -> None:
    """Their ratio is used where it differs from 1 by three of its errors, of 10 % here; else 1 is."""
    gains = np.repeat([of_x, of_y], 9)
    atmosphere = telemetry(4000, 0.0, model=LAYERS).open_loop_px
    rng = np.random.default_rng(4)
    slopes, commands = np.zeros_like(atmosphere), np.zeros((4000, 12))
    for frame in range(2, 4000):
        seen = gains * (atmosphere[frame] + INTERACTION @ commands[frame - 2])
        slopes[frame] = seen + 0.1 * rng.standard_normal(18)
        commands[frame] = 0.99 * commands[frame - 1] - 0.3 * PLANT.reconstructor.matrix @ slopes[frame]
    context = slopes, commands @ INTERACTION.T, np.zeros(4000, np.int64), TURBULENCE, 1 / FRAME_S
    seen = with_axes(DelayFits(*context).of(2.0), *context)
    assert abs(seen.measured_x_to_y - of_x / of_y) < 3 * seen.x_to_y_error < 0.5
    np.testing.assert_allclose(seen.gains(9), gains, rtol=0.15)
    assert (seen.x_to_y == 1.0) == (of_x == of_y)
