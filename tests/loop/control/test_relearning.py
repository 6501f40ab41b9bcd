"""Filters learnt from a loop and learnt again, beside it too: taken if better on frames not seen before."""

import operator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from tests.loop.control.control_cases import FRAME_S, LAYERS, PLANT, TURBULENCE, telemetry
from tests.loop.control.driven import driven, oscillator
from tests.loop.control.frozen_flow import frozen_slopes
from tests.loop.telemetry.loop_cases import AIR, NOISE_PX, RATE_HZ, recorded
from tests.refusals import refused

from faintspot.loop.control import beside_the_loop
from faintspot.loop.control.base import ASSUMED, OpenLoopTelemetry
from faintspot.loop.control.beside_the_loop import error_of_mean
from faintspot.loop.control.identification.learning import GAINS, learn_controller
from faintspot.loop.control.identification.loop_delay import DelayFits, LoopDelay
from faintspot.loop.control.identification.model import Kalman
from faintspot.loop.control.identification.predictive_control import PredictiveControl, learn
from faintspot.loop.control.identification.recording import Recording
from faintspot.loop.control.integrator import LoopPlant
from faintspot.loop.control.reconstructor import make_reconstructor
from faintspot.loop.control.relearning import relearn

FRAMES = telemetry(1200, 0.3, model=LAYERS)


@pytest.fixture(scope="module")
def now() -> Kalman:
    """Return a filter for the present turbulence, from other frames."""
    frames = telemetry(800, 0.3, seed=9, model=LAYERS)
    return learn_controller(PLANT, frames, TURBULENCE, 1 / FRAME_S, ASSUMED)


@pytest.mark.slow
def test_a_filter_for_other_turbulence_is_replaced(now: Kalman) -> None:
    """The running filter takes slopes for nearly constant."""
    arrays = now.arrays
    slow = {**arrays, "first": 0.1 * arrays["first"], "second": 0.0 * arrays["second"]}
    running = replace(now, arrays=slow)
    found = relearn(PLANT, running, FRAMES, TURBULENCE, 1 / FRAME_S, now.identified)
    assert found.is_better
    assert found.residual < 0.9 * found.by_running
    assert found.residual < found.by_integrator


@pytest.mark.slow
@pytest.mark.parametrize(("gain", "taken"), [(None, False), (0.5, True), (0.97, False)])
def test_another_centroid_gain_is_taken(now: Kalman, gain: float | None, taken: bool) -> None:
    """A filter for the same turbulence is replaced if its gain is wrong beyond the error."""
    delay = None if gain is None else LoopDelay(2.0, 0.0, gain, 0.03)
    found = relearn(PLANT, now, FRAMES, TURBULENCE, 1 / FRAME_S, now.identified, delay)
    assert found.is_better == found.gain_changed == taken
    if gain is None:
        assert found.residual == pytest.approx(found.by_running, rel=0.05)
    else:
        assert found.learnt.centroid_gain == gain
        assert f"centroid gain {gain:.3f}" in found.summary()


def test_too_few_frames_are_refused(now: Kalman) -> None:
    with refused("300"):
        relearn(PLANT, now, FRAMES.part(0, 300), TURBULENCE, 1 / FRAME_S)


def test_error_of_a_mean_of_correlated_values() -> None:
    """Every 5 values are the same: 80 blocks of 5 values each know the error to 8 %; three times that."""
    values = np.repeat(np.random.default_rng(3).normal(size=400), 5)
    assert error_of_mean(values) == pytest.approx(1 / np.sqrt(400), rel=0.25)


def test_the_latest_frames_are_kept_in_order() -> None:
    recent = beside_the_loop.RecentFrames(4, 2)
    for frame in range(beside_the_loop.FRAMES + 7):
        recent.add(np.full(4, float(frame)), np.full(2, -float(frame)))
    slopes, commands = recent.latest(3)
    np.testing.assert_array_equal(slopes[:, 0], beside_the_loop.FRAMES + np.arange(4, 7))
    np.testing.assert_array_equal(commands[:, 1], -beside_the_loop.FRAMES - np.arange(4.0, 7.0))
    assert len(recent) == len(recent.latest(10 * beside_the_loop.FRAMES)[0]) == beside_the_loop.FRAMES
    recent.clear()
    assert recent.latest(5)[0].shape == (0, 4)
    large = beside_the_loop.RecentFrames(9000, 4500)
    assert large._slopes.nbytes + large._commands.nbytes <= 64 << 20


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
    left = beside_the_loop.replayed_slopes(control, telemetry, matrix, 2)
    np.testing.assert_allclose(left, expected, rtol=0.01)


@pytest.mark.slow
def test_the_result_of_another_process() -> None:
    work = beside_the_loop.BesideTheLoop(operator.mul, "ab", 2)
    assert work.result() == "abab"
    assert not work.is_running
    assert beside_the_loop.BesideTheLoop(operator.truediv, 1, 0).result() is None


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
    turbulence = frozen_slopes(turned, 1700, RATE_HZ, rng)
    if how == "background":
        control.relearn = how
    before = in_loop(control, turbulence[:1100], rng)
    if how == "asked":
        control.learn_again()
    else:
        assert control._beside is not None
        control._beside.result()  # waits for the process
    after = in_loop(control, turbulence[1100:], rng)
    assert control.relearnt.endswith("taken")
    assert after[300:].mean() < 0.9 * before[300:].mean()


@pytest.mark.slow
def test_tip_and_tilt_of_a_single_sub_aperture_are_oscillators() -> None:
    """The vibration is found and the learnt filter beats the best integrator; delays are not told."""
    frames, rate_hz, noise = 8000, 500.0, 0.5
    turbulence, vibration = oscillator(1.5, 0.5, 1.0), oscillator(20.0, 0.003, 0.3)

    def seen(seed: int) -> OpenLoopTelemetry:
        rng = np.random.default_rng(seed)
        moving = turbulence, vibration, oscillator(45.0, 0.3, 0.4)
        slopes = np.array([driven(rng, frames, rate_hz, 2, *moving) for _ in range(2)]).T
        slopes += noise * rng.standard_normal(slopes.shape)
        return OpenLoopTelemetry(slopes, np.full(slopes.shape, noise**2), np.ones(slopes.shape))

    site = Recording(np.zeros((1, 2)), None, None, np.zeros((1, 2), np.int64), rate_hz).site
    plant, scoring = LoopPlant(np.eye(2), make_reconstructor(np.eye(2)), 2, 0.01), seen(3)
    learnt = learn_controller(plant, seen(2), site, rate_hz)
    assert learnt.identified is not None
    assert learnt.identified.noise_factor == pytest.approx(1.0, rel=0.1)
    for mode in ("tip", "tilt"):
        of_mode = [each for each in learnt.identified.oscillators if each.mode == mode]
        narrow = min(of_mode, key=lambda each: each.damping)
        # Its phase is lost within 3 s, which makes 0.1 Hz in 16 s.
        assert narrow.frequency_hz == pytest.approx(20.0, abs=0.3)
        assert narrow.rms_px == pytest.approx(vibration.rms_px, rel=0.4)
    gain, plain = plant.best_gain(GAINS, scoring, np.eye(2))
    left = plant.residual(partial(learnt.controller, plant), scoring, np.eye(2))
    # Noise is 0.5 of either, whatever the control; of the rest, the filter leaves at most three quarters.
    assert left - 2 * noise**2 < 0.75 * (plain - 2 * noise**2), gain
    with refused("3 sub-apertures"):
        DelayFits(scoring.open_loop_px, np.zeros((frames, 2)), np.zeros(frames, np.int64), site, rate_hz)
