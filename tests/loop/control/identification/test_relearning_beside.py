"""Frames of the running loop, and learning again from them beside it."""

import operator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.loop.control.frozen_flow import frozen_slopes
from tests.loop.telemetry.loop_cases import AIR, NOISE_PX, RATE_HZ, recorded

from faintspot.loop.control.base import OpenLoopTelemetry
from faintspot.loop.control.beside_the_loop import FRAMES, BesideTheLoop, RecentFrames, replayed_slopes
from faintspot.loop.control.identification.predictive_control import PredictiveControl, learn


def test_the_latest_frames_are_kept_in_order() -> None:
    recent = RecentFrames(4, 2)
    for frame in range(FRAMES + 7):
        recent.add(np.full(4, float(frame)), np.full(2, -float(frame)))
    slopes, commands = recent.latest(3)
    np.testing.assert_array_equal(slopes[:, 0], FRAMES + np.arange(4, 7))
    np.testing.assert_array_equal(commands[:, 1], -FRAMES - np.arange(4.0, 7.0))
    assert len(recent) == len(recent.latest(10 * FRAMES)[0]) == FRAMES
    recent.clear()
    assert recent.latest(5)[0].shape == (0, 4)


def test_frames_of_large_sensors_are_fewer() -> None:
    recent = RecentFrames(9000, 4500)
    assert recent._slopes.nbytes + recent._commands.nbytes <= 64 << 20


def test_residual_of_an_integrator_in_a_replay() -> None:
    """By the recursion itself: one command moves the first of two slopes, and sees it three times as large.

    Within 1 %, as the inverse of the matrix is regularised.
    """
    rng = np.random.default_rng(3)
    open_loop, matrix = rng.standard_normal((50, 2)), np.array([[2.0], [0.0]])
    commands, expected = [0.0, 0.0], []
    for slopes in open_loop:
        residual = slopes[0] + 2 * commands[-2]
        expected.append(residual**2 / 2)
        commands.append(commands[-1] - 0.2 * residual)
    sent = [np.zeros(1)]

    def control(slopes: np.ndarray) -> np.ndarray:
        sent.append(sent[-1] - 0.2 * slopes[:1])
        return sent[-1]

    telemetry = OpenLoopTelemetry(open_loop, np.ones((50, 2)), np.ones((50, 2)))
    left = replayed_slopes(control, telemetry, matrix, 2)
    np.testing.assert_allclose(left, expected, rtol=0.01)


@pytest.mark.slow
def test_the_result_of_another_process() -> None:
    work = BesideTheLoop(operator.mul, "ab", 2)
    assert work.result() == "abab"
    assert not work.is_running
    assert BesideTheLoop(operator.truediv, 1, 0).result() is None


def in_loop(control: PredictiveControl, turbulence: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the mean square of the true residual slopes of each frame; delay 2, centroid gain 1."""
    matrix = recorded().interaction_matrix
    sent = [np.zeros(matrix.shape[1])] * 2
    left = []
    for slopes in turbulence:
        residual = slopes + matrix @ sent[-2]
        sent.append(control(residual + NOISE_PX * rng.standard_normal(len(residual))))
        left.append(float(np.square(residual).mean()))
    return np.array(left)


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A controller that was learnt from the recording."""
    path = tmp_path_factory.mktemp("learnt") / "controller.npz"
    learn(recorded()).save(path)
    return path


@pytest.mark.slow
@pytest.mark.parametrize("how", ["asked", "background"])
def test_another_wind_is_learnt_from_the_running_loop(how: str, stored: Path) -> None:
    """Winds faster by 1.6 and turned by a quarter: the filter that knows them leaves at least 10 % less."""
    control, rng = PredictiveControl.load(stored), np.random.default_rng(12)
    turned = replace(AIR, wind_m_per_s=1.6 * AIR.wind_m_per_s @ np.array([[0.0, 1.0], [-1.0, 0.0]]))
    turbulence = frozen_slopes(turned, 2200, RATE_HZ, rng)
    if how == "background":
        control.relearn = how
    before = in_loop(control, turbulence[:1400], rng)
    if how == "asked":
        control.learn_again()
    else:
        assert control._beside is not None
        control._beside.result()  # waits for the process
    after = in_loop(control, turbulence[1400:], rng)
    assert control.relearnt.endswith("taken")
    assert after[300:].mean() < 0.9 * before[300:].mean()
