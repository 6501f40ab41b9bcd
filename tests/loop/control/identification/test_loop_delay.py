"""Delay and centroid gain of a loop, from its slopes and commands."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from tests.loop.control.control_cases import FRAME_S, INTERACTION, LAYERS, PLANT, TURBULENCE, telemetry
from tests.loop.control.frozen_flow import closed_loop, frozen_slopes
from tests.loop.telemetry.loop_cases import AIR, RATE_HZ, recorded

from faintspot.loop.control.identification.loop_delay import DelayFits, LoopDelay, with_axes
from faintspot.loop.control.reconstructor import make_reconstructor


def found(delay: int, gain: float, given: float | None = None) -> LoopDelay:
    loop = recorded(delay, gain)
    assert loop.commands is not None
    assert loop.interaction_matrix is not None
    held = loop.commands @ loop.interaction_matrix.T
    run = np.zeros(len(held), np.int64)
    fits = DelayFits(loop.slopes, held, run, AIR, RATE_HZ)
    return fits.best() if given is None else fits.of(given)


@pytest.mark.slow
@pytest.mark.parametrize("delay", [2, 3])
def test_the_delay_is_found_within_its_error(delay: int) -> None:
    """Within three of its errors, which ten seconds at this noise make 0.1 frames."""
    seen = found(delay, 1.0)
    assert seen.delay_error < 0.25
    assert abs(seen.delay_frames - delay) < 3 * seen.delay_error


@pytest.mark.slow
@pytest.mark.parametrize("gain", [0.8, 1.0])
def test_gain_for_a_known_delay(gain: float) -> None:
    seen = found(2, gain, given=2.0)
    assert seen.delay_frames == 2.0
    assert seen.gain_error < 0.1
    assert abs(seen.gain - gain) < 3 * seen.gain_error


def test_errors_of_gains_are_those_of_least_squares() -> None:
    """Of white noise and white commands. Half-overlapping pieces under a window, of whose frequencies every
    second counts, know gains less well, by sqrt(1 / 0.55).
    """
    site, frames = replace(AIR, positions_m=AIR.positions_m[[0, 1, 3, 4]]), 1500
    rng = np.random.default_rng(8)
    sent = 0.5 * rng.standard_normal((frames, 8))
    delayed = np.roll(sent, 2, axis=0)
    gains = np.repeat([0.9, 0.45], 4)
    context = sent, np.zeros(frames, np.int64), site, RATE_HZ
    slopes = gains * delayed + 0.8 * rng.standard_normal((frames, 8))
    gain, error, _ = DelayFits(slopes, *context, axis=0).gains_of(2.0)[3]
    # Three modes without tip; strengths of turbulence are fitted, too.
    least = 0.8 / 0.5 / np.sqrt(3 * frames)
    assert error == pytest.approx(least / np.sqrt(0.55), rel=0.15)
    assert abs(gain - 0.9) < 3 * error
    seen = with_axes(LoopDelay(2.0, 0.1, 0.6, 0.05), slopes, *context)
    assert seen.x_to_y == pytest.approx(2.0, rel=0.25)
    of_axes = error / 0.9, error / 0.45
    assert seen.x_to_y_error == pytest.approx(seen.x_to_y * np.linalg.norm([0.09, *of_axes]), rel=0.05)
    np.testing.assert_allclose(seen.gains(4), gains, rtol=0.15)
    least = np.hypot(0.04 * np.hypot(1, seen.gain), error)  # plus the change from one averaging to the next
    assert 0.9 * least < seen.gain_error < 1.5 * least


@pytest.mark.slow
def test_gain_in_bright_turbulence_without_fine_structure() -> None:
    """Within two errors. Turbulence of von Karman falls less steeply, and alone gave 0.51 +- 0.25."""
    rng = np.random.default_rng(3)
    turbulence = gaussian_filter1d(rng.standard_normal((2000, 18)), 5.0, axis=0)
    noise = 0.02 * rng.standard_normal((2000, 18))
    slopes, commands = closed_loop(turbulence, noise, INTERACTION, PLANT.reconstructor.matrix)
    context = slopes, commands @ INTERACTION.T, np.zeros(2000, np.int64), TURBULENCE, 1 / FRAME_S
    seen = DelayFits(*context).of(2.0)
    assert abs(seen.gain - 1.0) < 2 * seen.gain_error < 0.4


@pytest.mark.slow
@pytest.mark.parametrize(("of_x", "of_y"), [(0.4, 0.6), (0.6, 0.4), (0.5, 0.5)])
def test_gains_of_x_and_y(of_x: float, of_y: float) -> None:
    """Their ratio is used where it differs from 1 by three of its errors, of 10 % here; else 1 is."""
    gains = np.repeat([of_x, of_y], 9)
    atmosphere = telemetry(4000, 0.0, model=LAYERS).open_loop_px
    noise = 0.1 * np.random.default_rng(4).standard_normal(atmosphere.shape)
    loop = INTERACTION, PLANT.reconstructor.matrix
    slopes, commands = closed_loop(atmosphere, noise, *loop, seen=gains)
    context = slopes, commands @ INTERACTION.T, np.zeros(4000, np.int64), TURBULENCE, 1 / FRAME_S
    seen = with_axes(DelayFits(*context).of(2.0), *context)
    assert abs(seen.measured_x_to_y - of_x / of_y) < 3 * seen.x_to_y_error < 0.5
    np.testing.assert_allclose(seen.gains(9), gains, rtol=0.15)
    assert (seen.x_to_y == 1.0) == (of_x == of_y)


@pytest.mark.slow
def test_gain_of_a_large_sensor() -> None:
    """156 sub-apertures at 500 frames/s, within three errors. The mirror corrects large modes only; with 40
    sub-apertures apart from each other, what is between them looked like those, and the gain was 0.2.
    """
    rate_hz, gain, frames, rng = 500.0, 0.7, 2000, np.random.default_rng(7)
    rows, columns = np.mgrid[:14, :14] - 6.5
    cells = np.argwhere(np.hypot(rows, columns) < 7).astype(np.float64) - 6.5
    air = replace(AIR, positions_m=cells[:, ::-1] * AIR.subaperture_m)
    turbulence = frozen_slopes(air, frames, rate_hz, rng)
    noise = rng.normal(0, turbulence.std(), turbulence.shape)
    corners = np.unique((cells[:, None] + np.argwhere(np.ones((2, 2))) - 0.5).reshape(-1, 2), axis=0)
    apart = corners - cells[:, None]
    beside = (np.abs(apart) < 1).all(axis=2)
    matrix = np.vstack([beside * np.sign(apart[..., axis]) / 2 for axis in (1, 0)])
    inverse = make_reconstructor(matrix).matrix
    slopes, commands = closed_loop(turbulence, noise, matrix, inverse, seen=gain)
    context = slopes[100:], commands[100:] @ matrix.T, np.zeros(frames - 100, np.int64), air, rate_hz
    seen = DelayFits(*context).of(2.0)
    assert abs(seen.gain - gain) < 3 * seen.gain_error
