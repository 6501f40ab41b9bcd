from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are
from tests.control.control_cases import COVARIANCES, ERRORS, MODEL, telemetry

from faintspot.control.kalman import SlopePredictor, steady_covariance
from faintspot.control.models import SlopeModel


def _textbook() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return transition, driving noise and observation of the state [z[k], z[k - 1]]."""
    m = MODEL.slopes
    onward = np.block([[MODEL.first, MODEL.second], [np.eye(m), np.zeros((m, m))]])
    driving = np.zeros((2 * m, 2 * m))
    driving[:m, :m] = MODEL.driving
    return onward, driving, np.eye(m, 2 * m)


def test_yule_walker_gives_back_a_model() -> None:
    """Covariances of the model itself, summed up over its past; predictions differ
    by the ridge, a small part of what cannot be predicted.
    """
    onward, driving, _ = _textbook()
    state = np.zeros_like(driving)
    for _ in range(4000):
        state = onward @ state @ onward.T + driving
    m = MODEL.slopes
    again = SlopeModel.of_covariances(np.array([state[:m, :m], state[:m, m:], (onward @ state)[:m, m:]]))
    wrong = (again.both - MODEL.both) @ state @ (again.both - MODEL.both).T
    assert wrong.trace() < 0.05 * MODEL.driving.trace()
    assert again.driving.trace() == pytest.approx(MODEL.driving.trace(), rel=0.1)
    assert MODEL.driving.trace() < 0.05 * COVARIANCES[0].trace()


def test_ahead_repeats_the_recursion() -> None:
    onward, _, seen = _textbook()
    np.testing.assert_allclose(MODEL.ahead(0), seen)
    np.testing.assert_allclose(MODEL.ahead(3), seen @ onward @ onward @ onward, atol=1e-12)


def test_the_steady_error_solves_the_riccati_equation() -> None:
    onward, driving, seen = _textbook()
    variance = np.linspace(0.05, 0.5, MODEL.slopes)
    expected = solve_discrete_are(onward.T, seen.T, driving, np.diag(variance))
    np.testing.assert_allclose(steady_covariance(MODEL, variance), expected, atol=1e-8)


@pytest.mark.parametrize("steady", [True, False])
def test_the_filter_is_the_textbook_s(steady: bool) -> None:
    """With equal noise in all frames, a Kalman filter written out that starts with the steady error."""
    onward, driving, seen = _textbook()
    variance = ERRORS**2
    predictor = SlopePredictor(MODEL, variance, steady=steady)
    state, error = np.zeros(2 * MODEL.slopes), predictor.covariance
    for slopes in telemetry(60).open_loop_px:
        predictor.correct(slopes.copy(), variance)
        gain = error @ seen.T @ np.linalg.inv(seen @ error @ seen.T + np.diag(variance))
        state = state + gain @ (slopes - seen @ state)
        error = (np.eye(len(state)) - gain @ seen) @ error
        np.testing.assert_allclose(predictor.state, state, atol=1e-7)
        predictor.advance()
        state, error = onward @ state, onward @ error @ onward.T + driving
        np.testing.assert_allclose(predictor.state, state, atol=1e-7)


def test_predictions_are_as_far_off_as_they_say() -> None:
    """Innovations hold the noise, too; 3000 frames, correlated: within 5 %."""
    frames = telemetry(3000, 0.3)
    predictor = SlopePredictor(MODEL, frames.variance_px2[0])
    surprise = []
    for slopes, variance in zip(frames.open_loop_px, frames.variance_px2, strict=True):
        surprise.append(slopes - predictor.mean_px)
        predictor.correct(slopes, variance)
        predictor.advance()
    said = np.sqrt(predictor.std_px**2 + 0.3**2)
    assert np.std(surprise, axis=0).mean() == pytest.approx(said.mean(), rel=0.05)


@pytest.mark.parametrize("steady", [True, False])
def test_what_was_not_measured_does_not_count(steady: bool) -> None:
    predictor = SlopePredictor(MODEL, ERRORS**2, steady=steady)
    before = predictor.state.copy()
    predictor.correct(np.full(18, 1e3), np.full(18, np.inf))
    np.testing.assert_array_equal(predictor.state, before)
