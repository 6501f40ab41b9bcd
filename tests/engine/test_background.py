"""Learning beside an engine: what is better is handed over, and the loop goes on whatever happens to it."""

import threading
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.loop.control.control_cases import FRAME_S, INTERACTION, LAYERS, PLANT, TURBULENCE, telemetry
from tests.refusals import refused

from faintspot.base.errors import InputError
from faintspot.engine.background import BackgroundLearning, _watch
from faintspot.engine.control.control_loop import ControlLoop
from faintspot.engine.processes.requests import ControlServer, socket_path
from faintspot.engine.request_handlers import commands_of
from faintspot.engine.telemetry.ring import TelemetryRing
from faintspot.loop.control.base import ASSUMED, SETTLE_FRAMES, OpenLoopTelemetry
from faintspot.loop.control.configuration import Control, save_control
from faintspot.loop.control.identification.learning import learn_controller
from faintspot.loop.control.identification.model import Kalman
from faintspot.loop.control.integrator import LoopPlant
from faintspot.loop.control.options import ControlOptions
from faintspot.loop.control.relearning import RelearntControl
from faintspot.slopes.pipeline import configuration as configuration_file
from faintspot.slopes.pipeline.slopes import RESULT_TYPES, Slopes
from faintspot.slopes.sensor.layout import Layout

LAYOUT = Layout.grid((3, 3), pixels=8, subaperture_m=0.6)
NOISE_PX, FRAMES = 0.3, 600
OPEN_LOOP = telemetry(FRAMES, NOISE_PX, model=LAYERS).open_loop_px
OPTIONS = ControlOptions(controller="kalman")


@pytest.fixture(scope="module")
def model() -> Kalman:
    frames = telemetry(500, NOISE_PX, seed=9, model=LAYERS)
    return learn_controller(PLANT, frames, TURBULENCE, 1 / FRAME_S, ASSUMED)


def outdated(model: Kalman) -> Kalman:
    """Return the model of slopes that are forgotten from frame to frame."""
    arrays = {**model.arrays, "first": 0.1 * model.arrays["first"], "second": 0.0 * model.arrays["second"]}
    return Kalman(arrays, 0.4, 1.0, model.left, model.phase_of_commands)


class Run:
    """A loop on known open-loop slopes, whose records go into telemetry."""

    def __init__(
        self, name: str, model: Kalman, centroid_gain: float = 1.0, records: int | None = None
    ) -> None:
        self._gain = centroid_gain
        self.loop = ControlLoop(Control(INTERACTION, None, OPTIONS, model), LAYOUT)
        self.ring = TelemetryRing.create(name, LAYOUT, commands=INTERACTION.shape[1], records=records)
        self._sent, self._number = [np.zeros(INTERACTION.shape[1])] * 2, 0
        self.loop.close()

    def frames(self, count: int) -> np.ndarray:
        """Let frames come; return the commands."""
        sent = []
        for number in range(self._number, self._number + count):
            seen = self._gain * (OPEN_LOOP[number] + INTERACTION @ self._sent.pop(0)).astype(np.float32)
            arrays = [np.zeros(9, kind) for kind in RESULT_TYPES]
            arrays[:2] = np.split(seen, 2)
            arrays[-3:-1] = [np.full(9, self._gain * NOISE_PX, np.float32)] * 2
            slopes = Slopes(*arrays)
            self.loop.take_turn(None)
            sent.append(self.loop.follow(slopes, number).copy())
            self.loop.look_after(slopes.flux)
            self._sent.append(sent[-1])
            now = round(number * FRAME_S * 1e9)
            self.ring.write(number, 0, 0, (now, now), slopes, loop=2, commands=sent[-1])
        self._number += count
        return np.array(sent)


def configured(folder: Path, model: Kalman) -> Path:
    """Write the configuration of an engine with a filter; return its path."""
    path = folder / "faintspot.toml"
    configuration_file.save(path, LAYOUT)
    np.save(folder / "m.npy", INTERACTION)
    model.save(folder / "model.npz")
    save_control(path, interaction_matrix="m.npy", controller="kalman", model="model.npz")
    return path


@pytest.mark.slow  # compiles kernels of filters for itself
def test_a_new_filter_goes_on_from_the_mirror(name: str, model: Kalman) -> None:
    """No step is larger than those before; in the end commands are those of one that was always there.

    Its slopes are half as large, which it knows; the guard's limits are those of slopes as configured.
    """
    other, run = Run(f"{name}_2", model), Run(name, outdated(model), 0.5)
    model = replace(model, centroid_gain=0.5)
    before, others = run.frames(100), other.frames(100 + SETTLE_FRAMES + 100)
    run.loop.renew(model)
    after = run.frames(SETTLE_FRAMES + 100)
    assert run.loop.control.model is model
    steps = np.linalg.norm(np.diff(np.vstack([before, after]), axis=0), axis=1)
    takes_over = np.abs(np.arange(len(steps)) - (100 + SETTLE_FRAMES + 5)) < 10
    assert steps[takes_over].max() < steps[~takes_over].max()
    largest = np.abs(after).max()
    assert np.abs(after[:SETTLE_FRAMES] - others[100:-100]).max() > 0.2 * largest
    np.testing.assert_allclose(after[-85:], others[-85:], atol=0.02 * largest)
    residual = other.loop.guard.residual_px
    assert run.loop.guard.residual_px == pytest.approx(0.5 * residual, rel=0.05)
    with refused("first"):
        run.loop.renew(replace(model, arrays={**model.arrays, "first": np.eye(3)}))
    for each in (run, other):
        each.ring.close()


@pytest.mark.parametrize("engine_ends", [True, False])
def test_a_process_that_ends_before_the_engine_is_a_fault(engine_ends: bool) -> None:
    def check() -> None:
        raise InputError("learn: killed")

    done, faults = iter([False, engine_ends]), list[str]()
    _watch(SimpleNamespace(check=check), SimpleNamespace(wait=lambda _: next(done)), faults.append)  # type: ignore[arg-type]
    assert faults == ([] if engine_ends else ["learn: killed"])


@pytest.mark.slow
def test_a_better_filter_is_handed_to_the_engine(
    name: str, model: Kalman, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same is found twice, which is better than what runs only the first time."""

    def relearnt(plant: LoopPlant, running: Kalman, frames: OpenLoopTelemetry, *_: Any) -> RelearntControl:
        found = frames.open_loop_px
        rows = [OPEN_LOOP[first : first + 298] for first in (2, 302)]
        assert any(np.allclose(found, slopes - slopes.mean(axis=0), atol=1e-3) for slopes in rows)
        return RelearntControl(model, 1.0, 1.0 if running is model else 2.0, 3.0, 0.1)

    monkeypatch.setattr("faintspot.engine.background.relearn", relearnt)
    monkeypatch.setattr("faintspot.engine.background.FEWEST_FRAMES", 90)
    path = configured(tmp_path, outdated(model))
    save_control(path, controller="integrator")
    with refused("controller"):
        BackgroundLearning(name, path, 1.0)
    save_control(path, controller="kalman")
    run = Run(name, outdated(model))
    estimators = SimpleNamespace(changing=threading.Lock())
    engine: Any = SimpleNamespace(loop=run.loop, learning=None, estimators=estimators)
    handlers = {
        "learnt": commands_of(engine)["learnt"],
        "get": lambda _: {"settings": {"estimator": "window"}},
    }
    with ControlServer(socket_path(name), handlers, lengthy=("learnt",)):
        learning = BackgroundLearning(name, path, 280 * FRAME_S)
        run.frames(100)
        assert not learning.take()
        run.frames(200)
        assert learning.take()
        found, taken = learning.learn()
        assert taken
        assert engine.learning["taken"]
        assert engine.learning["found"] == found.summary()
        assert run.loop.control.model.description == ""  # as read from the file
        run.frames(300)  # at once, longer than is asked for
        learning._every_s /= 3
        assert learning.take()
        _, taken = learning.learn()
        assert not taken
        assert not engine.learning["taken"]
        learning.close()
    run.ring.close()
    assert learning._reader.stale


def test_it_never_learns_across_records_that_were_lost(
    name: str, model: Kalman, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frames before and after a gap are no time series: what waits is forgotten, and it begins anew."""
    monkeypatch.setattr("faintspot.engine.background.FEWEST_FRAMES", 90)
    run = Run(name, model, records=150)
    learning = BackgroundLearning(name, configured(tmp_path, model), 180 * FRAME_S)
    run.frames(120)
    assert not learning.take()
    run.frames(200)  # more than the ring holds
    assert not learning.take()
    run.frames(140)
    assert not learning.take()  # with the frames before the gap it would be enough
    run.frames(60)
    assert learning.take()
    frames = np.concatenate([records["frame"] for records in learning._records])
    assert (frames[0], len(frames)) == (320, 200)
    assert (np.diff(frames) == 1).all()
    learning.close()
    run.ring.close()
