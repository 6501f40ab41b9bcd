"""Estimators in NumPy: whatever `locate` does, a frame has slopes or flags, and errors are one line."""

import os
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.refusals import refused

import faintspot as fs
from faintspot.slopes.estimators import Estimator, Positions, estimators, register
from faintspot.slopes.estimators.registry import restore
from faintspot.slopes.recorded.measuring import measure_recorded

LAYOUT = fs.Layout.grid((2, 3), pixels=8)
BRIGHT = 1000.0
SPOT = np.zeros(LAYOUT.window, np.float32)
SPOT[2:4, 5:7] = 50.0
FRAME = np.tile(SPOT, (2, 3))


@dataclass(frozen=True, eq=False, kw_only=True)
class Custom(Estimator):
    """Whatever `action` returns; in dim frames zero."""

    action: Any = None
    always: bool = False
    name = "custom"
    label = "custom"

    def locate(self, images: Any, sensor: Any, prior: Any) -> Any:
        if self.always or images.max() >= BRIGHT:
            return self.action(images, sensor)
        return sensor.zero


def pipeline(action: Callable[..., Any], always: bool = False) -> fs.SlopePipeline:
    return fs.SlopePipeline(LAYOUT, Custom(action=action, always=always))


def raising(error: BaseException) -> Callable[..., Any]:
    def locate(images: Any, sensor: Any) -> Any:
        raise error

    return locate


FAULTS = [ValueError("two\nlines"), SystemExit(0), KeyboardInterrupt(), GeneratorExit(), MemoryError()]


@pytest.mark.parametrize("error", FAULTS, ids=lambda error: type(error).__name__)
def test_one_that_always_fails_is_refused(error: BaseException) -> None:
    with refused("estimator 'custom' of ", "test_python.py", "(line ", type(error).__name__):
        pipeline(raising(error), always=True)


@pytest.mark.parametrize(
    "result", [np.zeros((6, 3)), np.zeros(6), None, "x", Positions(np.zeros(6), np.zeros(5)), 1j]
)
def test_results_of_another_kind_are_refused(result: Any) -> None:
    with refused("estimator 'custom' of "):
        pipeline(lambda images, sensor: result, always=True)


@pytest.mark.parametrize("error", FAULTS, ids=lambda error: type(error).__name__)
def test_a_frame_that_fails_is_flagged_and_counted(error: BaseException) -> None:
    found = pipeline(raising(error))
    frames = np.stack([FRAME, FRAME * BRIGHT, FRAME])
    slopes = found(frames)
    assert slopes.valid.all(axis=1).tolist() == [True, False, True]
    assert not slopes.valid[1].any()
    assert np.all(slopes.vector == 0)
    assert np.all(slopes.flux[1] == 0)
    assert np.all(np.isinf(slopes.standard_error_x))
    assert found.plan.prepared.faults == 1
    assert type(error).__name__ in found.plan.prepared.fault


def test_what_is_not_usable_is_flagged_alone() -> None:
    def locate(images: Any, sensor: Any) -> Any:
        x, y, flux, error = np.zeros((4, len(images)))
        x[0], y[1], flux[2], x[3], error[4] = np.nan, np.inf, 1e300, 4.1, np.nan
        return Positions(x, y, flux, standard_error_x=error)

    slopes = pipeline(locate)(FRAME * BRIGHT)
    assert slopes.valid.tolist() == [False, False, False, False, True, True]
    assert np.isinf(slopes.standard_error_x).tolist() == [True] * 5 + [False]
    for values in (slopes.x, slopes.y, slopes.flux):
        assert np.all(np.isfinite(values))


def test_a_covariance_counts_where_both_errors_are_known() -> None:
    """And is at most their product."""

    def locate(images: Any, sensor: Any) -> Any:
        x, error = np.zeros(6), np.full(6, 0.1)
        covariance = np.array([0.004, -0.02, np.nan, 0.004, 0.004, 0.0])
        error[3] = np.inf
        return Positions(x, x, standard_error_x=error, standard_error_y=error, covariance_xy=covariance)

    slopes = pipeline(locate)(FRAME * BRIGHT)
    np.testing.assert_allclose(slopes.covariance_xy, [0.004, -0.01, 0, 0, 0.004, 0], rtol=1e-6)


def test_what_it_is_given_is_its_own() -> None:
    """Images may be written into; the reference positions may not."""

    def locate(images: Any, sensor: Any) -> Any:
        images[:] = -1
        assert not sensor.zero.flags.writeable
        return np.zeros((6, 2))

    slopes = pipeline(locate)(FRAME * BRIGHT)
    assert np.all(slopes.flux == SPOT.sum() * BRIGHT)


def test_ctrl_c_is_the_users() -> None:
    def locate(images: Any, sensor: Any) -> Any:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(60)

    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        pipeline(locate)(FRAME * BRIGHT)
    assert signal.getsignal(signal.SIGINT) is before


@pytest.fixture
def known() -> Iterator[None]:
    before = estimators()
    register(Custom)
    yield
    restore(before)


@pytest.mark.usefixtures("known")
def test_recorded_frames_that_fail_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def locate(self: Any, images: Any, sensor: Any, prior: Any) -> Any:
        if images.max() >= BRIGHT:
            raise SystemExit(0)
        return sensor.zero

    monkeypatch.setattr(Custom, "locate", locate)
    configuration = tmp_path / "faintspot.toml"
    configuration.write_text('[layout.grid]\nshape = [2, 3]\npixels = 8\n[estimator]\nname = "custom"\n')
    np.save(tmp_path / "a.npy", np.stack([FRAME, FRAME * BRIGHT, FRAME]))
    summary = measure_recorded([tmp_path / "a.npy"], configuration, tmp_path / "s.npz", block_frames=1)
    assert summary.bad_frames == 1
    assert summary.notes[-1].startswith("1 frames without slopes: ")
    assert "SystemExit: 0" in summary.notes[-1]
