"""Filters of modes: the steady state of their Kalman filters, and predictions from them."""

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from faintspot.loop.control.kalman.modal_predictor import (
    LAGS,
    ModalPredictor,
    modal_filter,
    prediction_errors,
)

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
def test_a_reply_is_what_a_surprise_adds_to_the_prediction(arrays: dict[str, np.ndarray]) -> None:
    predictor = ModalPredictor(arrays)
    predictor.correct(np.array([1.0, 2.0]), np.full(2, NOISE))
    (reply,) = predictor.replies(2)
    np.testing.assert_allclose(reply @ [1.0, 2.0], predictor.ahead(2))


@pytest.mark.parametrize("arrays", [ARRAYS, COUPLED])
def test_matrices_predict_as_the_filter_does(arrays: dict[str, np.ndarray]) -> None:
    predictor, rng = ModalPredictor(arrays), np.random.default_rng(3)
    onward, correction, observation, ahead = predictor.matrices(2)
    state = np.zeros(len(onward))
    for row in rng.standard_normal((40, 2)):
        predictor.correct(row, np.full(2, NOISE))
        state = state + correction @ (row - observation @ state)
        np.testing.assert_allclose(ahead @ state, predictor.ahead(2), atol=1e-12)
        predictor.advance()
        state = onward @ state


def test_the_past_of_the_first_mode_corrects_all() -> None:
    """By the estimate of 8 frames ago, where the coupling is that alone."""
    coupling = np.zeros((len(LAGS), 2))
    coupling[1] = 1.0, -2.0
    alone, coupled = (
        ModalPredictor(COUPLED | {"coupling": np.zeros((1, 2))}),
        ModalPredictor(COUPLED | {"coupling": coupling}),
    )
    for predictor in alone, coupled:
        predictor.begin(np.array([3.0, 1.0]))
    np.testing.assert_allclose(coupled.ahead(2) - alone.ahead(2), [3.0, -6.0])
