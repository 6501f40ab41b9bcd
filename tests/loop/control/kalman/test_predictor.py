import numpy as np
import pytest
from scipy.linalg import block_diag, solve_discrete_are
from tests.loop.control.control_cases import COVARIANCES, ERRORS, LAYERS, MODEL, telemetry

from faintspot.loop.control.kalman.predictor import SlopeModel, SlopePredictor, steady_covariance

MODELS = pytest.mark.parametrize("model", [MODEL, LAYERS], ids=["one layer", "two layers"])


def _textbook(model: SlopeModel = MODEL) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return transition, driving noise and observation of the state [y[k], y[k - 1]] of all layers."""
    m = model.slopes
    zero = np.zeros((m, m))
    layers = zip(model.first, model.second, model.driving, strict=True)
    parts = [
        (np.block([[first, second], [np.eye(m), zero]]), np.block([[driving, zero], [zero, zero]]))
        for first, second, driving in layers
    ]
    onward, driving = (block_diag(*each) for each in zip(*parts, strict=True))
    return onward, driving, np.hstack([np.eye(m), zero] * len(parts))


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
    wrong = (again.both - MODEL.both)[0] @ state @ (again.both - MODEL.both)[0].T
    assert wrong.trace() < 0.05 * MODEL.driving[0].trace()
    assert again.driving[0].trace() == pytest.approx(MODEL.driving[0].trace(), rel=0.1)
    assert MODEL.driving[0].trace() < 0.05 * COVARIANCES[0].trace()


@MODELS
def test_state_and_error_follow_the_recursion(model: SlopeModel) -> None:
    onward, driving, seen = _textbook(model)
    np.testing.assert_allclose(model.ahead(0), seen)
    np.testing.assert_allclose(model.ahead(3), seen @ onward @ onward @ onward, atol=1e-12)
    once = onward @ driving @ onward.T + driving
    np.testing.assert_allclose(model.spread(driving, 2), onward @ once @ onward.T + driving, atol=1e-12)
    variance = np.linspace(0.05, 0.5, model.slopes)
    expected = solve_discrete_are(onward.T, seen.T, driving, np.diag(variance))
    np.testing.assert_allclose(steady_covariance(model, variance), expected, atol=1e-8)


@MODELS
@pytest.mark.parametrize("steady", [True, False])
def test_the_filter_is_the_textbook_s(model: SlopeModel, steady: bool) -> None:
    """With equal noise in all frames, a Kalman filter written out that starts with the steady error."""
    onward, driving, seen = _textbook(model)
    variance = ERRORS**2
    predictor = SlopePredictor(model, variance, steady=steady)
    before = predictor.state.copy()
    predictor.correct(np.full(model.slopes, 1e3), np.full(model.slopes, np.inf))  # not measured
    np.testing.assert_array_equal(predictor.state, before)
    state, error = np.zeros(model.states), predictor.covariance
    for slopes in telemetry(60).open_loop_px:
        predictor.correct(slopes.copy(), variance)
        gain = error @ seen.T @ np.linalg.inv(seen @ error @ seen.T + np.diag(variance))
        state = state + gain @ (slopes - seen @ state)
        error = (np.eye(len(state)) - gain @ seen) @ error
        np.testing.assert_allclose(predictor.state, state, atol=1e-7)
        predictor.advance()
        state, error = onward @ state, onward @ error @ onward.T + driving
        np.testing.assert_allclose(predictor.state, state, atol=1e-7)
        np.testing.assert_allclose(predictor.mean_px, seen @ state, atol=1e-7)


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


def test_a_filter_begins_at_the_slopes_it_is_given() -> None:
    """The layers share them, so that their sum is what is expected of the first frame."""
    predictor = SlopePredictor(LAYERS, np.square(ERRORS))
    slopes = np.linspace(-1.0, 2.0, LAYERS.slopes)
    predictor.begin(slopes)
    np.testing.assert_allclose(predictor.mean_px, slopes, rtol=1e-12)
