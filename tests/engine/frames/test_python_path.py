"""An estimator in NumPy in the engine: the pipeline's slopes, and no fault beyond its frame."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from tests.engine.bench import LAYOUT, SETTINGS, make, simulated
from tests.patience import wait_for
from tests.refusals import refused

import faintspot as fs
from faintspot.engine.frames.frame_path import Progress
from faintspot.engine.frames.python_path import PythonPath, call_is_under_way, call_within, end_thread, tried
from faintspot.engine.frames.workers import SlopePrior
from faintspot.slopes.estimators import Estimator, Positions

pytestmark = pytest.mark.slow

GENEROUS_S = 5.0
BRIGHT = 60000


@dataclass(frozen=True, eq=False, kw_only=True)
class Odd(Estimator):
    """The prior; on a frame with a very bright pixel something else."""

    action: Any = None
    name = "odd"
    label = "odd"

    def locate(self, images: Any, sensor: Any, prior: Any) -> Any:
        if self.action is not None and images.max() > BRIGHT / 2:
            return self.action(images, prior)
        moved: Any = prior + images[:, :2, 0] / 1000
        images[:] = np.nan  # a copy of its own
        return moved


class Source:
    """One slot with a whole frame in it, and a way through an estimator in NumPy."""

    def __init__(self, action: Callable[[Any, Any], Any] | None, budget_s: float = GENEROUS_S) -> None:
        self.slots = np.zeros((1, *LAYOUT.frame_shape), np.uint16)
        self.cells = np.array([-1, LAYOUT.frame_shape[0]], np.int64)
        self.pipeline = make(SETTINGS.replace(estimator=Odd(action=action)))
        self.prior = SlopePrior(len(LAYOUT))
        progress = Progress(self.cells, 0, 1)
        self.path = PythonPath(self.pipeline, self.slots, progress, prior=self.prior, budget_s=budget_s)
        self.path.warm_up()
        self.data = simulated(1)[0]
        self.bright = self.data.copy()
        corner = LAYOUT.corners[7]
        self.bright[corner[0] + 2, corner[1] + 2] = BRIGHT

    def measure(self, frame: Any) -> fs.Slopes:
        self.slots[0] = frame
        self.cells[0] += 1
        assert self.path.measure(int(self.cells[0]), 0)
        self.path.locate()
        return self.path.slopes


def assert_same(found: fs.Slopes, expected: fs.Slopes) -> None:
    for name, values in expected.variables.items():
        np.testing.assert_array_equal(getattr(found, name), values, err_msg=name)


def fail(images: Any, prior: Any) -> Any:
    raise SystemExit("too bright")


def partly(images: Any, prior: Any) -> Any:
    x, y, flux = np.zeros((3, len(images)))
    x[0], y[1], flux[2], y[3] = np.nan, np.inf, 1e300, 4.1
    return Positions(x, y, flux, standard_error_x=np.where(np.arange(len(x)) == 4, np.nan, 0.1))


def late(images: Any, prior: Any) -> Any:
    time.sleep(0.3)
    return prior


def endless(images: Any, prior: Any) -> Any:
    while True:
        pass


def test_slopes_are_those_of_the_pipeline() -> None:
    source = Source(None)
    assert_same(source.measure(source.data), source.pipeline(source.data))
    expected = np.random.default_rng(1).uniform(-1, 1, 2 * len(LAYOUT))
    source.prior.expect(expected)
    assert_same(source.measure(source.data), source.pipeline(source.data, prior=expected))


def test_single_subapertures_that_are_not_usable() -> None:
    source = Source(partly)
    slopes = source.measure(source.bright)
    assert_same(slopes, source.pipeline(source.bright))
    assert np.flatnonzero(~slopes.valid).tolist() == [0, 1, 2, 3]
    assert np.isfinite(slopes.flux).all()
    assert np.flatnonzero(np.isinf(slopes.standard_error_x)).tolist() == [0, 1, 2, 3, 4]
    assert not source.path.failed


def test_three_failures_in_a_row_are_a_fault() -> None:
    source = Source(fail)
    for _ in range(3):
        assert source.path.fault is None
        source.measure(source.bright)
    assert "SystemExit: too bright" in str(source.path.fault)
    assert not source.measure(source.data).valid.any()  # it is not called any more
    source.path._thread.join(GENEROUS_S)
    assert not source.path._thread.is_alive()


def test_one_that_never_returns() -> None:
    source = Source(endless, 0.02)
    assert not source.measure(source.bright).valid.any()
    assert "did not return" in str(source.path.fault)
    source.path._thread.join(GENEROUS_S)  # Python code ends where it is told to
    assert not source.path._thread.is_alive()


def test_one_that_is_too_slow() -> None:
    """Single late frames are its own; three in a row are a fault, but not while another one is tried."""
    source, over = Source(late, 0.1), threading.Event()
    for frame in (source.bright, source.bright, source.data, source.bright):
        assert source.measure(frame).valid.all()
    trial = threading.Thread(target=call_within, args=(GENEROUS_S, "trial", over.wait))
    trial.start()
    for _ in range(3):
        source.measure(source.bright)
    assert source.path.fault is None
    over.set()
    trial.join()
    for _ in range(3):
        source.measure(source.bright)
    assert source.path.fault is not None


def test_trial_refuses_failing_and_slow_estimators() -> None:
    def settings(action: Any) -> fs.Settings:
        return SETTINGS.replace(estimator=Odd(action=action))

    assert tried(make, settings(None), GENEROUS_S)(simulated(1)).valid.all()
    with refused("too bright"):
        tried(make, settings(fail), GENEROUS_S)
    with refused("estimator 'odd'", "us a frame"):
        tried(make, settings(None), 1e-9)


PATIENCE_S = 10.0


def forever() -> None:
    while True:
        pass


def test_calls_that_come_back_in_time_and_others() -> None:
    assert call_within(PATIENCE_S, "sum", lambda *numbers: sum(numbers), 1, 2) == 3
    assert call_within(PATIENCE_S, "nothing", lambda: None) is None
    assert call_within(PATIENCE_S, "itself", call_is_under_way)
    with pytest.raises(ValueError, match="two"):
        call_within(PATIENCE_S, "number", int, "two")
    known = set(threading.enumerate())
    with refused("loop", "0.05 s"):
        call_within(0.05, "loop", forever)
    wait_for(lambda: not set(threading.enumerate()) - known)
    assert not call_is_under_way()
    end_thread(threading.Thread(target=forever))  # one that has not begun is left alone
