"""Filters of modes: the steady state of their Kalman filters, and predictions from them."""

from functools import partial
from typing import Any

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are
from tests.loop.control.control_cases import (
    FRAME_S,
    INTERACTION,
    PHASE,
    PHASE_OF_COMMANDS,
    PLANT,
    TURBULENCE,
    telemetry,
)
from tests.loop.control.naive_guarded import Guarded
from tests.patience import mostly_slow

from faintspot.loop.control import integrator
from faintspot.loop.control.base import CommandDelayLine
from faintspot.loop.control.kalman.compiled import Predictive
from faintspot.loop.control.kalman.guard import MOST_EXCESS
from faintspot.loop.control.kalman.guarded import GuardedController
from faintspot.loop.control.kalman.local_predictor import LocalPredictor, local_filter
from faintspot.loop.control.kalman.modal_predictor import (
    LAGS,
    LargeGuarded,
    ModalPredictor,
    modal_filter,
    prediction_errors,
)
from faintspot.slopes.kernels.products import add_slopes

ORDER, NOISE = 4, 0.3


def spectrum(weights: np.ndarray) -> np.ndarray:
    """Return that of an autoregression driven by unit noise."""
    return np.asarray(1 / np.abs(np.fft.fft(np.append(1.0, -weights), 4096)) ** 2)


WEIGHTS = np.array([[1.3, -0.4, 0.05, -0.02], [0.5, 0.2, -0.1, 0.1]])
POWER = np.array([spectrum(row) for row in WEIGHTS]).T + NOISE
ARRAYS = modal_filter(POWER, np.full(2, NOISE), ORDER)
COUPLED = modal_filter(POWER, np.full(2, NOISE), ORDER, LAGS[-1] + 1)
COUPLED["coupling"] = np.random.default_rng(2).standard_normal((len(LAGS), 2))
"""By the past of the first mode."""


def test_the_steady_state_is_that_of_the_riccati_equation() -> None:
    """Within the ridge of 1e-4 of the variance."""
    for mode, weights in enumerate(WEIGHTS):
        step, seen = np.eye(ORDER, k=-1), np.eye(ORDER)[:1]
        step[0] = weights
        error = solve_discrete_are(step.T, seen.T, seen.T @ seen + 1e-12 * np.eye(ORDER), [[NOISE]])
        gains = error[:, 0] / (error[0, 0] + NOISE)
        np.testing.assert_allclose(ARRAYS["coefficients"][:, mode], weights, atol=0.01)
        np.testing.assert_allclose(ARRAYS["gains"][:, mode], gains, atol=0.005)
        assert ARRAYS["predicted_px2"][mode] == pytest.approx(error[0, 0], rel=0.01)


@pytest.mark.parametrize("frames", [1, 3])
def test_all_predictions_at_once_are_those_of_the_filter(frames: int) -> None:
    modes, predictor = np.random.default_rng(1).standard_normal((50, 2)), ModalPredictor(ARRAYS)
    errors = modes.copy()
    for number, row in enumerate(modes[:-frames]):
        predictor.correct(row, np.full(2, NOISE))
        errors[number + frames] -= predictor.ahead(frames)
        predictor.advance()
    np.testing.assert_allclose(prediction_errors(ARRAYS, modes, frames), errors, atol=1e-12)


def test_a_mode_that_was_not_measured_corrects_nothing() -> None:
    one, other = ModalPredictor(ARRAYS), ModalPredictor(ARRAYS)
    one.correct(np.array([1.0, 2.0]), np.array([NOISE, np.inf]))
    other.correct(np.array([1.0, 0.0]), np.full(2, NOISE))
    np.testing.assert_array_equal(one.state, other.state)


@pytest.mark.parametrize("arrays", [ARRAYS, COUPLED])
def test_matrices_and_replies_predict_as_the_filter_does(arrays: dict[str, np.ndarray]) -> None:
    """A reply is what the first surprise adds to the prediction."""
    predictor, rng = ModalPredictor(arrays), np.random.default_rng(3)
    (reply,) = predictor.replies(2)
    onward, correction, observation, ahead = predictor.matrices(2)
    state = np.zeros(len(onward))
    for number, row in enumerate(rng.standard_normal((40, 2))):
        predictor.correct(row, np.full(2, NOISE))
        state = state + correction @ (row - observation @ state)
        np.testing.assert_allclose(ahead @ state, predictor.ahead(2), atol=1e-12)
        assert number or reply @ row == pytest.approx(predictor.ahead(2))
        predictor.advance()
        state = onward @ state


def test_the_past_of_the_first_mode_corrects_all() -> None:
    """By the estimate of 8 frames ago, where the coupling is that alone."""
    coupling = np.zeros((len(LAGS), 2))
    coupling[1] = 1.0, -2.0
    alone, coupled = (ModalPredictor(COUPLED | {"coupling": each}) for each in (np.zeros((1, 2)), coupling))
    for predictor in alone, coupled:
        predictor.begin(np.array([3.0, 1.0]))
    np.testing.assert_allclose(coupled.ahead(2) - alone.ahead(2), [3.0, -6.0])


M, COMMANDS = INTERACTION.shape
GAIN, FRAMES = 0.4, telemetry(250)


def wrong_filter() -> dict[str, Any]:
    """Return the arrays of a filter with the wrong sign in its weights."""
    arrays = local_filter(TURBULENCE.layers(), FRAME_S, np.full(M, 0.25))
    return {**arrays, "weights": -0.5 * arrays["weights"]}


@pytest.fixture
def both() -> tuple[list[GuardedController], list[CommandDelayLine]]:
    """Return the controllers, plain and fast."""
    arrays = wrong_filter()
    lines = [CommandDelayLine(COMMANDS, 2, 0.8) for _ in range(2)]
    options: dict[str, Any] = {"prior_std_px": np.full(M, 0.7), "noise_factor": 1.3}

    def learnt(line: CommandDelayLine) -> Predictive:
        predictor = LocalPredictor(arrays)
        return Predictive(line, INTERACTION, predictor, PLANT.reconstructor.clean, from_latest=True)

    fast = LargeGuarded(lines[1], PLANT, PHASE_OF_COMMANDS, arrays, GAIN, **options)
    plain = partial(PLANT.integrator, GAIN)
    return [Guarded(lines[0], INTERACTION, PHASE, learnt, plain, **options), fast], lines


@pytest.mark.parametrize("fails", mostly_slow(1, [True, False]))
def test_it_does_the_same_before_and_after_the_integrator_takes_over(
    both: tuple[list[GuardedController], list[CommandDelayLine]], fails: bool
) -> None:
    """By computed residuals, or because the filter's measured one is too large.

    The tolerances are those of float32 in a filter that diverges.
    """
    controllers, lines = both
    rng, chosen = np.random.default_rng(2), []
    for number, slopes in enumerate(FRAMES.open_loop_px):
        error: np.ndarray = np.where(rng.random(M) < 0.1, np.inf, 0.3 * rng.uniform(0.5, 1.5, M))
        if fails and number == 10:
            for controller in controllers:
                controller._guard["excess"] = 2 * MOST_EXCESS
        if number == 200:
            for controller, line in zip(controllers, lines, strict=True):
                line.hold(np.full(COMMANDS, 0.1))
                controller.begin()
        for controller, line in zip(controllers, lines, strict=True):
            controller.update(np.where(np.isfinite(error), slopes + INTERACTION @ line.acting, 0.0), error)
        np.testing.assert_allclose(lines[1].latest, lines[0].latest, rtol=1e-4, atol=5e-4)
        expected = [each.expected() for each in controllers]
        np.testing.assert_allclose(expected[1].mean_px, expected[0].mean_px, rtol=1e-4, atol=5e-4)
        assert (expected[1].std_px is None) == (expected[0].std_px is None)
        assert controllers[0].chosen == controllers[1].chosen
        chosen.append(controllers[0].chosen)
    assert chosen[0] == 0
    assert chosen[-1] == 1
    assert (chosen[9:11] == [0, 1]) == fails
    assert np.abs(lines[1].latest).max() > 0.1


def test_a_command_that_is_begun_while_slopes_are_measured_is_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Both of the filter and of the integrator that takes over; the tolerance is that of float32."""
    monkeypatch.setattr(integrator, "_LEAST_BYTES", 0)
    arrays, rng, chosen = wrong_filter(), np.random.default_rng(3), []
    lines = [CommandDelayLine(COMMANDS, 2, 0.8) for _ in range(2)]
    others = PLANT, PHASE_OF_COMMANDS, arrays, GAIN
    both = whole, begun = [LargeGuarded(line, *others, noise_factor=1.3) for line in lines]
    n = M // 2
    for number, open_loop in enumerate(FRAMES.open_loop_px):
        slopes = (2.0 * (open_loop + INTERACTION @ lines[0].acting)).astype(np.float32)
        flags = (rng.random(n) < 0.1).astype(np.uint8)
        valid = np.tile(flags == 0, 2)
        error: np.ndarray = np.where(valid, 0.3, np.inf)
        parts = begun.begin_product(2, 0.5)
        assert len(parts) == (2 if number else 0)
        last = rng.integers(n)  # the rest has not been measured in time
        for part in parts[:1]:
            add_slopes(part, slopes[:n], slopes[n:], flags, 0, last)
        flags[0] = 1  # found out after the frame
        valid[[0, n]] = False
        true = np.where(valid, 0.5 * slopes.astype(np.float64), 0.0)
        for controller in both:
            controller.update(true, np.where(valid, error, np.inf))
        np.testing.assert_allclose(lines[1].latest, lines[0].latest, rtol=1e-4, atol=1e-4)
        for controller in both:
            controller.expected()
        assert whole.chosen == begun.chosen
        chosen.append(begun.chosen)
    assert chosen[0] == 0
    assert chosen[-1] == 1


def test_nothing_is_begun_with_a_prior_or_before_the_frame_is_complete(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(integrator, "_LEAST_BYTES", 0)
    line = CommandDelayLine(COMMANDS, 2, 0.8)
    others = PLANT, PHASE_OF_COMMANDS, wrong_filter(), GAIN
    controller = LargeGuarded(line, *others)
    controller.update(np.zeros(M), np.full(M, 0.3))
    assert not controller.begin_product(1, 1.0)
    controller.expected()
    assert controller.begin_product(1, 1.0)
    line.put(line.latest)  # of a frame that was lost
    assert not controller.begin_product(1, 1.0)
    controller.expected()
    controller.prior_std_px = np.full(M, 0.7)
    assert not controller.begin_product(1, 1.0)
