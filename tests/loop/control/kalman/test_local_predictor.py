"""The filter for large sensors, against the one in which all slopes interact and against loops."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.loop.control.control_cases import CELLS, FRAME_S, LAYERS, PLANT, TURBULENCE, telemetry
from tests.loop.control.frozen_flow import frozen_slopes
from tests.refusals import refused

from faintspot.loop.control.base import CommandDelayLine
from faintspot.loop.control.identification import model as models
from faintspot.loop.control.identification.learning import learn_controller
from faintspot.loop.control.identification.model import Kalman
from faintspot.loop.control.kalman import local_model
from faintspot.loop.control.kalman import local_predictor as local_kalman
from faintspot.loop.control.kalman.local_model import LocalModel, at_most, neighbours_within, solve_locally
from faintspot.loop.control.kalman.local_predictor import LocalPredictor, local_filter
from faintspot.loop.control.kalman.predictor import SlopeModel, SlopePredictor
from faintspot.loop.control.kalman.predictor import steady_covariance as dense_covariance
from faintspot.loop.control.reconstructor import add_noise

SIDE_M = TURBULENCE.subaperture_m
PAIR = replace(TURBULENCE, positions_m=CELLS[[0, 1, 3, 4]][:, ::-1] * SIDE_M)  # all adjacent to each other
NOISE_PX2 = np.full(18, 0.25)
SHARED_PX2 = np.linspace(-0.2, 0.2, 9)  # of x and y


@pytest.fixture(scope="module")
def arrays() -> dict[str, Any]:
    return local_filter(TURBULENCE.layers(), FRAME_S, NOISE_PX2)


def test_neighbours_are_those_within_the_distance() -> None:
    near = neighbours_within(CELLS, 1.0)
    assert near.shape == (9, 5)
    np.testing.assert_array_equal(near[:, 0], np.arange(9))
    assert set(near[4]) == {1, 3, 4, 5, 7}
    assert set(near[0]) == {0, 1, 3, 9}


def test_small_equations_are_solved_among_neighbours() -> None:
    rng = np.random.default_rng(1)
    matrix, right = np.cov(rng.standard_normal((6, 30))), rng.standard_normal((3, 2, 6))
    chosen = np.array([[0, 1, 5], [3, 6, 6], [6, 6, 6]])
    solved = solve_locally(matrix, right, chosen, 0.1)
    for own, index in enumerate(chosen):
        there = index[index < 6]
        local = matrix[np.ix_(there, there)] + 0.1 * np.eye(len(there))
        expected = np.linalg.solve(local, right[own][:, there].T).T
        np.testing.assert_allclose(solved[own][:, index < 6], expected, atol=1e-12)
        assert not solved[own][:, index == 6].any()


def test_weak_layers_join_those_of_similar_wind(monkeypatch: pytest.MonkeyPatch) -> None:
    winds = np.array([[10.0, 0.0], [0.0, 8.0], [9.0, 1.0]])
    air = replace(TURBULENCE, fraction=np.array([0.5, 0.3, 0.2]), wind_m_per_s=winds)
    two = at_most(air.layers(), 2)
    np.testing.assert_allclose(two[0].wind_m_per_s, [(5 * winds[0] + 2 * winds[2]) / 7])
    np.testing.assert_array_equal(two[1].wind_m_per_s, winds[[1]])
    strength = sum(each.r0_m ** (-5 / 3) for each in two)
    assert strength == pytest.approx(air.r0_m ** (-5 / 3))
    monkeypatch.setattr(local_kalman, "_MOST_STATES", 4 * 18)
    assert len(local_filter(air.layers(), FRAME_S, NOISE_PX2)["share"]) == 2


def _transition(model: LocalModel) -> np.ndarray:
    return np.asarray(local_model._transition(model.neighbours, model.weights).toarray(), np.float64)


def test_where_all_are_neighbours_the_model_is_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(local_model, "_RIDGE", 1e-4)  # that of the model of all slopes
    monkeypatch.setattr(local_model, "_FADING", 0.0)
    local = LocalModel.of_layers(PAIR.layers(), FRAME_S)
    dense = SlopeModel.of_covariances(np.array([layer.lagged_px2(FRAME_S) for layer in PAIR.layers()]))
    m = dense.slopes
    blocks = _transition(local).reshape(2, m, 2, 2, m)
    for layer in range(2):
        np.testing.assert_allclose(blocks[layer, :, 0, layer], dense.first[layer], atol=1e-6)
        np.testing.assert_allclose(blocks[layer, :, 1, layer], dense.second[layer], atol=1e-6)
        assert not blocks[layer, :, :, 1 - layer].any()
    np.testing.assert_allclose(local.driving, dense.driving, rtol=0.01, atol=1e-6)


def test_driving_noise_is_what_neighbours_do_not_explain() -> None:
    model = LocalModel.of_layers(TURBULENCE.layers(), FRAME_S)
    step = _transition(model).reshape(2, 18, 2, 2, 18)
    for layer, air in enumerate(TURBULENCE.layers()):
        same, one, two = air.lagged_px2(FRAME_S)
        weights = np.hstack([step[layer, :, 0, layer], step[layer, :, 1, layer]])
        past, onward = np.block([[same, one], [one.T, same]]), np.hstack([one, two])
        left = same - weights @ onward.T - onward @ weights.T + weights @ past @ weights.T
        np.testing.assert_allclose(model.driving[layer], left, atol=1e-5 * np.trace(same))


@pytest.mark.parametrize("reach", [1.0, 9.0])
def test_a_step_of_the_covariance_is_the_textbooks(reach: float, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(local_model, "_AT_ONCE", 4)
    """With gains among all, and with those that know only some neighbours (Joseph's form)."""
    model = LocalModel.of_layers(TURBULENCE.layers(), FRAME_S)
    before = local_model._prior(TURBULENCE.layers(), FRAME_S).astype(np.float64)
    around, half = neighbours_within(CELLS, reach), len(before) // 2
    step = np.vstack([_transition(model), np.eye(half, 2 * half)])
    noise = np.diag(NOISE_PX2)
    add_noise(noise, np.zeros(18), SHARED_PX2)
    seen = np.hstack([np.eye(18), np.eye(18), np.zeros((18, half))])
    gain = np.zeros((2 * half, 18))
    total, across = seen @ before @ seen.T + noise, before @ seen.T
    for row in range(2 * half):
        near = around[row % 9][around[row % 9] < 9]
        both = np.concatenate([near, near + 9])
        gain[row, both] = np.linalg.solve(total[np.ix_(both, both)], across[row, both])
    left = np.eye(2 * half) - gain @ seen
    expected = step @ (left @ before @ left.T + gain @ noise @ gain.T) @ step.T
    for layer in range(2):
        part = slice(18 * layer, 18 * (layer + 1))
        expected[part, part] += model.driving[layer]
    found = local_model._next(
        before.astype(np.float32),
        local_model._transition(model.neighbours, model.weights),
        model.driving.astype(np.float32),
        (NOISE_PX2, SHARED_PX2),
        around,
    )
    np.testing.assert_allclose(found, expected, atol=1e-5 * before.max())


@pytest.mark.slow
def test_errors_die_away() -> None:
    """Without measurements to follow, any error shrinks with all gains: no frame of noise stays.

    Gains made for the covariance of the best filter let errors with periods of six sub-apertures grow.
    """
    positions: Any = 0.5 * np.argwhere(np.ones((14, 14)))
    winds = [[5.6, 2.1], [2.1, 11.8], [-7.5, -20.7]]
    layers: Any = {"fraction": np.array([0.6, 0.25, 0.15]), "wind_m_per_s": np.array(winds)}
    air = replace(TURBULENCE, positions_m=positions, subaperture_m=0.5, **layers)
    usual = np.full(392, float(np.diag(air.covariance_px2()).mean()))
    predictor = LocalPredictor(local_filter(air.layers(), 1 / 500, usual))
    assert max(predictor.remaining(air.positions_m, level) for level in range(7)) < 0.9995


def test_the_error_is_nearly_that_of_the_riccati_equation(arrays: dict[str, Any]) -> None:
    """Steps of eight frames are coarse: within a third of the variance."""
    covariance = dense_covariance(LAYERS, NOISE_PX2)
    expected = np.diag(LAYERS.observation @ covariance @ LAYERS.observation.T)
    np.testing.assert_allclose(arrays["predicted_px2"], expected, rtol=0.35)


@pytest.mark.parametrize("layers", [1, 3])
def test_kernels_equal_loops(layers: int) -> None:
    rng = np.random.default_rng(layers)
    n, near, around = 4, neighbours_within(CELLS[:4], 1.0), neighbours_within(CELLS[:4], 2.0)
    state = np.zeros((n + 1, 2, layers, 2), np.float32)
    state[:-1] = rng.standard_normal(state[:-1].shape)
    surprise = np.zeros((n + 1, 2), np.float32)
    surprise[:-1] = rng.standard_normal((n, 2))
    gains = rng.standard_normal((n, around.shape[1], 2, 4 * layers)).astype(np.float32)
    weights = rng.standard_normal((n, near.shape[1], 2, layers, 2, 2)).astype(np.float32)
    corrected, later = state.astype(np.float64), np.zeros(state.shape)
    for i in range(n):
        for j, other in enumerate(around[i]):
            corrected[i] += (surprise[other].astype(np.float64) @ gains[i, j]).reshape(2, layers, 2)
        later[i, 1] = state[i, 0]
        for j, other in enumerate(near[i]):
            later[i, 0] += np.einsum("tlao,tlo->la", weights[i, j].astype(np.float64), state[other])
    found = np.zeros_like(state)
    local_kalman._ADVANCE(state, weights, near, found)
    local_kalman._CORRECT(state, gains, around, surprise)
    np.testing.assert_allclose(found, later, atol=1e-5)
    np.testing.assert_allclose(state, corrected, atol=1e-5)


def _mean_square_error(predictor: Any, slopes: np.ndarray, noisy: np.ndarray, noise_px: float) -> float:
    predictor.begin(np.zeros(slopes.shape[1]))
    errors = []
    for now, later in zip(noisy, slopes[2:], strict=False):
        predictor.correct(now, np.full(len(now), noise_px**2))
        errors.append(predictor.ahead(2) - later)
        predictor.advance()
    return float(np.square(errors[100:]).mean())


def test_it_predicts_nearly_as_well_as_the_full_filter() -> None:
    """5 x 5 sub-apertures in frozen flow that shares nothing with the theory: 12 % of the error's variance
    are allowed for what is left out, with 3 % of scatter between realisations.
    """
    positions: Any = SIDE_M * np.argwhere(np.ones((5, 5)))
    air = replace(TURBULENCE, positions_m=positions, r0_m=0.26)
    rng = np.random.default_rng(3)
    slopes = frozen_slopes(air, 700, 1 / FRAME_S, rng)
    noise_px = float(slopes.std())
    noisy = slopes + noise_px * rng.standard_normal(slopes.shape)
    variance = np.full(50, noise_px**2)
    model = SlopeModel.of_covariances(np.array([layer.lagged_px2(FRAME_S) for layer in air.layers()]))
    dense = _mean_square_error(SlopePredictor(model, variance, steady=True), slopes, noisy, noise_px)
    local = LocalPredictor(local_filter(air.layers(), FRAME_S, variance))
    assert _mean_square_error(local, slopes, noisy, noise_px) < 1.12 * dense
    assert dense < 0.2 * np.square(slopes).mean()


def test_what_was_not_measured_counts_nothing_and_noisier_frames_less(arrays: dict[str, Any]) -> None:
    predictor, other = LocalPredictor(arrays), LocalPredictor(arrays)
    slopes, variance = np.random.default_rng(1).standard_normal(18), np.full(18, 0.25)
    variance[3] = np.inf
    predictor.correct(slopes, variance)
    other.correct(np.where(np.arange(18) == 3, 99.0, slopes), variance)
    np.testing.assert_array_equal(predictor.mean_px, other.mean_px)
    before, moved = predictor.mean_px, []
    predictor.correct(slopes, np.full(18, np.inf))
    np.testing.assert_array_equal(predictor.mean_px, before)
    for noise_px2 in (0.02, 0.25, 3.0, 1e5):
        predictor = LocalPredictor(arrays)
        predictor.correct(np.ones(18), np.full(18, noise_px2))
        moved.append(np.abs(predictor.mean_px).mean())
    assert moved[0] > moved[1] > moved[2] >= moved[3] > 0


def test_it_begins_with_given_slopes_and_looks_ahead(arrays: dict[str, Any]) -> None:
    predictor, slopes = LocalPredictor(arrays), np.linspace(-1, 1, 18)
    predictor.begin(slopes)
    np.testing.assert_allclose(predictor.mean_px, slopes, atol=1e-6)
    ahead = [predictor.ahead(frames) for frames in range(3)]
    for expected in ahead:
        np.testing.assert_allclose(predictor.mean_px, expected, atol=1e-6)
        predictor.advance()


@pytest.mark.slow
def test_large_sensors_learn_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Learnt, saved and read again it sends the same commands, and leaves less than the integrator."""
    monkeypatch.setattr(models, "MOST_SLOPES", 10)
    frames = telemetry(600, 0.3, model=LAYERS)
    shown: list[tuple[int, int]] = []
    learnt = learn_controller(
        PLANT, frames, TURBULENCE, 1 / FRAME_S, progress=lambda *each: shown.append(each)
    )
    assert shown[-1][0] == shown[-1][1] == len(shown)
    assert learnt.is_local
    assert learnt.left[0] < learnt.left[1]
    path = tmp_path / "model.npz"
    learnt.save(path)
    again = Kalman.load(path, PLANT)
    assert again.is_local
    sent = []
    for model in (learnt, again):
        line = CommandDelayLine(12, 2)
        controller = model.guarded(PLANT, line)
        for slopes in frames.open_loop_px[:40]:
            controller.update(slopes + PLANT.interaction @ line.acting, np.full(18, 0.3))
        sent.append(line.latest.copy())
    np.testing.assert_array_equal(sent[0], sent[1])
    damaged = {"near": again.arrays["near"][:4], "around": again.arrays["around"] + 9}
    for name, array in damaged.items():
        with refused(name):
            replace(again, arrays={**again.arrays, name: array}).check(PLANT)
