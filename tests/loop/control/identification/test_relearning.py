"""A filter learnt again is taken if it is better on frames that it has not seen, and not otherwise."""

from dataclasses import replace

import numpy as np
import pytest
from tests.loop.control.control_cases import FRAME_S, LAYERS, PLANT, TURBULENCE, telemetry
from tests.refusals import refused

from faintspot.loop.control.base import ASSUMED
from faintspot.loop.control.identification.learning import error_of_mean, learn_controller
from faintspot.loop.control.identification.loop_delay import LoopDelay
from faintspot.loop.control.identification.model import Kalman
from faintspot.loop.control.relearning import relearn

RATE_HZ = 1 / FRAME_S
FRAMES = telemetry(1200, 0.3, model=LAYERS)


@pytest.fixture(scope="module")
def now() -> Kalman:
    """Return a filter for the present turbulence, from other frames."""
    return learn_controller(PLANT, telemetry(800, 0.3, seed=9, model=LAYERS), TURBULENCE, RATE_HZ, ASSUMED)


@pytest.mark.slow
def test_a_filter_for_other_turbulence_is_replaced(now: Kalman) -> None:
    """The running filter takes slopes for nearly constant."""
    arrays = now.arrays
    slow = {**arrays, "first": 0.1 * arrays["first"], "second": 0.0 * arrays["second"]}
    running = replace(now, arrays=slow)
    found = relearn(PLANT, running, FRAMES, TURBULENCE, RATE_HZ, now.identified)
    assert found.is_better
    assert found.residual < 0.9 * found.by_running
    assert found.residual < found.by_integrator


@pytest.mark.slow
def test_a_filter_that_is_as_good_stays(now: Kalman) -> None:
    found = relearn(PLANT, now, FRAMES, TURBULENCE, RATE_HZ, now.identified)
    assert not found.is_better
    assert found.residual == pytest.approx(found.by_running, rel=0.05)


def test_too_few_frames_are_refused(now: Kalman) -> None:
    with refused("300"):
        relearn(PLANT, now, FRAMES.part(0, 300), TURBULENCE, RATE_HZ)


def test_error_of_a_mean_of_correlated_values() -> None:
    """Every 5 values are the same: 80 blocks of 5 values each know the error to 8 %; three times that."""
    values = np.repeat(np.random.default_rng(3).normal(size=400), 5)
    assert error_of_mean(values) == pytest.approx(1 / np.sqrt(400), rel=0.25)


@pytest.mark.slow
@pytest.mark.parametrize(("gain", "taken"), [(0.5, True), (0.97, False)])
def test_another_centroid_gain_is_taken(now: Kalman, gain: float, taken: bool) -> None:
    """A filter for the same turbulence is replaced if its gain is wrong beyond the error."""
    found = relearn(PLANT, now, FRAMES, TURBULENCE, RATE_HZ, now.identified, LoopDelay(2.0, 0.0, gain, 0.03))
    assert found.is_better == found.gain_changed == taken
    assert found.learnt.centroid_gain == gain
    assert f"centroid gain {gain:.3f}" in found.summary()
