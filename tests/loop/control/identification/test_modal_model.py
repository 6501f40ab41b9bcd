"""Control of loops without geometry, learnt from slopes and commands alone."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter
from tests.loop.control.control_states import Controls
from tests.loop.control.modal_cases import (
    NOISE,
    Floats,
    commands_of_matrices,
    integrated,
    recorded,
    wandering,
)
from tests.patience import try_states
from tests.refusals import refused

from faintspot.loop.control.base import CommandDelayLine
from faintspot.loop.control.identification.modal_delay import spectra_of_modes
from faintspot.loop.control.identification.modal_model import coupling
from faintspot.loop.control.identification.predictive_control import PredictiveControl, learn
from faintspot.loop.control.kalman.modal_predictor import LAGS, modal_filter

GAIN, LOOP_GAIN, DELAY = 0.8, 0.4, 2
FRAMES = 2500


def driven(control: Any, open_loop: Floats, matrix: Floats, seed: int) -> float:
    """Return the mean square of the residual, without noise, that a control leaves in new frames."""
    rng, waiting, squares = np.random.default_rng(seed), [np.zeros(matrix.shape[1])] * DELAY, []
    for row in open_loop:
        residual = row + matrix @ waiting[0]
        slopes = GAIN * residual + NOISE * rng.standard_normal(len(residual))
        waiting = [*waiting[1:], control(slopes)]
        squares.append(float(residual @ residual))
    return float(np.mean(squares[1000:]))


class Integrator:
    """The integrator that was recorded."""

    def __init__(self, matrix: Floats) -> None:
        self._step, self._command = LOOP_GAIN * np.linalg.pinv(matrix), np.zeros(matrix.shape[1])

    def __call__(self, slopes: Floats) -> Floats:
        self._command = 0.99 * self._command - self._step @ slopes
        return self._command


@pytest.fixture(scope="module")
def tip_tilt() -> PredictiveControl:
    rng = np.random.default_rng(1)
    return learn(recorded(*integrated(wandering(rng, FRAMES), rng)))


@pytest.mark.slow
def test_tip_and_tilt_are_better_than_with_the_integrator(tip_tilt: PredictiveControl) -> None:
    """By 20 % of the variance, in new frames, with the guard."""
    open_loop = wandering(np.random.default_rng(2), 2500)
    plain = driven(Integrator(np.eye(2)), open_loop, np.eye(2), 3)
    tip_tilt.reset()
    assert driven(tip_tilt, open_loop, np.eye(2), 3) < 0.8 * plain
    assert tip_tilt.is_predicting
    assert tip_tilt.delay_frames.value == DELAY
    assert "an integrator of gain 0.4 ran" in tip_tilt.summary()


@pytest.mark.slow
def test_a_modal_loop_of_slopes_in_any_order() -> None:
    """Five modes in 41 slopes, of which one is constant and one is missing half of the time."""
    rng = np.random.default_rng(6)
    matrix, frames = rng.standard_normal((41, 5)), 3000
    matrix[7] = 0.0
    open_loop = wandering(rng, frames, 5)
    slopes, commands = integrated(open_loop, rng)
    seen = slopes @ matrix.T
    seen[:, 7], seen[::2, 9] = 0.25, np.nan
    control = learn(recorded(seen, commands, matrix))
    assert control.left_out.tolist() == [7]
    assert control.delay_frames.value == DELAY
    new = wandering(np.random.default_rng(7), 3000, 5) @ matrix.T
    assert driven(control, new, matrix, 8) < 0.9 * driven(Integrator(matrix), new, matrix, 8)


@pytest.mark.slow
def test_the_fallback_of_modes_is_the_recorded_integrator() -> None:
    """Although the replay advises less than its gain of 1.1."""
    rng = np.random.default_rng(14)
    control = learn(recorded(*integrated(wandering(rng, 1500), rng, loop_gain=1.1)))
    assert control.integrator_gain < 1.1 / 1.5
    assert "fallback" not in control.summary()


def test_controller_from_a_file_does_the_same(tip_tilt: PredictiveControl, tmp_path: Path) -> None:
    """The controller that is read does the same; so do the exported matrices, without the guard."""
    rows = np.random.default_rng(9).standard_normal((200, 2))
    tip_tilt.save(tmp_path / "controller.npz")
    read = PredictiveControl.load(tmp_path / "controller.npz")
    tip_tilt.reset()
    np.testing.assert_array_equal([read(row) for row in rows], [tip_tilt(row) for row in rows])
    assert read.left_out.size == 0
    tip_tilt.export(tmp_path / "matrices.npz")
    file, line = dict(np.load(tmp_path / "matrices.npz")), CommandDelayLine(2, DELAY)
    alone = tip_tilt.model.controller(tip_tilt._plant, line)
    for row, command in zip(rows, commands_of_matrices(file, rows), strict=True):
        alone.update(*tip_tilt._controlled(tip_tilt._loop.scale * row, np.ones(2)))
        np.testing.assert_allclose(command, line.latest, atol=1e-9)


@pytest.mark.hypothesis
def test_a_controller_is_its_model_whatever_comes(tip_tilt: PredictiveControl) -> None:
    try_states(type("TipTilt", (Controls,), {"learnt": tip_tilt}), 12, 10)


def test_slopes_that_are_not_measured(tip_tilt: PredictiveControl) -> None:
    tip_tilt.reset()
    for row in ([np.nan, np.nan], [1e9, 0.1], [0.1, -0.1]):
        assert np.isfinite(tip_tilt(row)).all()
    with refused("slopes", "(2,)", "(3,)"):
        tip_tilt(np.zeros(3))


def test_bad_recordings_are_refused() -> None:
    rng = np.random.default_rng(1)
    slopes, commands = integrated(wandering(rng, 1000), rng)
    for rows, sent, word in (
        (300, commands, "326"),
        (1000, np.zeros_like(commands), "closed loop"),
        (1000, rng.standard_normal(commands.shape), "slopes"),
    ):
        with refused("commands" if rows == 1000 else "frames", word):
            learn(recorded(slopes[:rows], sent[:rows]))


def test_what_the_wind_carries_from_mode_to_mode_is_predicted() -> None:
    """Eight modes, each with what the one before it had 10 frames ago; or all independent."""
    rng, frames = np.random.default_rng(11), 3000
    independent = lfilter([1.0], [1.0, -0.8], rng.standard_normal((frames + 70, 8)), axis=0)
    carried = np.array([independent[70 - 10 * k : frames + 70 - 10 * k, 0] for k in range(8)]).T
    for modes, least, most in ((carried, 0.3, 1.0), (independent[70:], 0.0, 0.01)):
        noisy = modes + 0.5 * rng.standard_normal(modes.shape)
        found, saved = coupling(modal_filter(*spectra_of_modes(noisy), 4, LAGS[-1] + 1), noisy, DELAY)
        assert found.shape == (len(LAGS) * 8, 8)
        assert least <= saved <= most
