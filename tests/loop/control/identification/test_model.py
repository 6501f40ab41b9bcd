"""What was learnt is the same after it was in a file, and goes on from any mirror without a jump."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.loop.control.control_cases import COVARIANCES, FRAME_S, INTERACTION, PLANT, TURBULENCE, telemetry
from tests.refusals import refused

from faintspot.loop.control.base import CommandDelayLine
from faintspot.loop.control.configuration import Control
from faintspot.loop.control.identification.learning import learn_controller
from faintspot.loop.control.identification.model import Kalman
from faintspot.loop.control.kalman.compiled import CompiledKalman
from faintspot.loop.control.options import ControlOptions
from faintspot.slopes.camera.calibration import Calibration

FRAMES = telemetry(600, 0.3)


@pytest.fixture(scope="module")
def learnt() -> Kalman:
    return learn_controller(PLANT, FRAMES, TURBULENCE, 1 / FRAME_S)


def commands(controller: Any, line: CommandDelayLine, frames: int = 60) -> np.ndarray:
    sent = []
    for slopes in FRAMES.open_loop_px[:frames]:
        controller.update(slopes + INTERACTION @ line.acting, np.full(18, 0.3))
        sent.append(line.latest.copy())
    return np.array(sent)


@pytest.mark.slow
def test_from_a_file_it_is_the_same(learnt: Kalman, tmp_path: Path) -> None:
    path = tmp_path / "model.npz"
    learnt.save(path)
    lines = [CommandDelayLine(12, 2) for _ in range(2)]
    models = zip((learnt, Kalman.load(path, PLANT)), lines, strict=True)
    sent = [commands(model.guarded(PLANT, line), line) for model, line in models]
    np.testing.assert_array_equal(sent[0], sent[1])
    assert np.abs(sent[0]).max() > 0.1
    options = ControlOptions(controller="kalman", leak=PLANT.leak, gain=1.0)
    control = Control(INTERACTION, None, options, path)
    line = control.line()
    engines = commands(control.controller(line), line)
    np.testing.assert_allclose(engines, sent[0], rtol=0, atol=1e-9)


@pytest.mark.slow
def test_it_goes_on_from_what_the_mirror_holds(learnt: Kalman) -> None:
    """Slopes of a mirror that takes off all there is: the next command is nearly the same."""
    line = CommandDelayLine(12, 2)
    controller = learnt.guarded(PLANT, line)
    commands(controller, line)
    held = -PLANT.reconstructor.clean @ COVARIANCES[0] @ np.random.default_rng(2).standard_normal(18)
    line.hold(held)
    controller.begin()
    controller.update(np.zeros(18), np.full(18, 0.3))
    assert np.linalg.norm(line.latest - held) < 0.35 * np.linalg.norm(held)


@pytest.mark.slow
def test_another_controller_of_the_same_loop(learnt: Kalman) -> None:
    """The integrator needs no model; only the filter tells estimators what it expects, if nothing is said."""
    control = Control(INTERACTION, None, ControlOptions(gain=0.3), learnt)
    filtered = control.with_controller("kalman")
    assert isinstance(filtered.controller(filtered.line()), CompiledKalman)
    assert (control.prediction, filtered.prediction) == ("none", "controller")
    assert filtered.with_controller("integrator").options == control.options
    assert control.with_controller("integrator") is control


def test_what_is_refused(learnt: Kalman, tmp_path: Path) -> None:
    path, kalman = tmp_path / "model.npz", ControlOptions(controller="kalman")
    with refused("model"):
        Control(INTERACTION, None, kalman, None)
    learnt.save(path)
    with refused("read noise"):
        Control(INTERACTION, None, kalman, learnt).check_errors(Calibration())
    Control(INTERACTION, None, kalman, learnt).check_errors(Calibration(read_noise_e=1.0))
    Control(INTERACTION).check_errors(Calibration())
    with refused("prediction = 'stream'"):
        Control(INTERACTION, None, ControlOptions(controller="kalman", prediction="stream"), path)
    arrays = dict(np.load(path))
    layers = len(arrays["first"])
    damages: list[tuple[dict[str, Any], str]] = [
        ({"first": arrays["first"][0]}, "first: expected shape (1, 18, 18), got (18, 18)"),
        (
            {"first": np.tile(arrays["first"], (2, 1, 1))},
            f"second: expected shape ({2 * layers}, 18, 18), got ({layers}, 18, 18)",
        ),
        ({"variance_px2": np.full(18, np.nan)}, "variance_px2"),
        ({"kind": "pid"}, "kind = 'pid'"),
    ]
    for damage, word in damages:
        np.savez(path, **{**arrays, **damage})
        with refused(word):
            Control(INTERACTION, None, kalman, path)
    np.savez(path, kind="kalman")
    with refused("model.npz"):
        Control(INTERACTION, None, kalman, path)


def test_centroid_gain_in_the_file(learnt: Kalman, tmp_path: Path) -> None:
    """Slopes are divided by it and by the configured one; the integrator knows the latter only."""
    path = tmp_path / "model.npz"
    replace(learnt, centroid_gain=0.4).save(path)
    control = Control(INTERACTION, None, ControlOptions(controller="kalman", centroid_gain=0.5), path)
    assert control.centroid_gain == pytest.approx(0.2)
    assert control.with_controller("integrator").centroid_gain == 0.5
    arrays = dict(np.load(path))
    np.savez(path, **{name: array for name, array in arrays.items() if name != "centroid_gain"})
    assert Kalman.load(path, PLANT).centroid_gain == 1.0
    np.savez(path, **{**arrays, "centroid_gain": 0.0})
    with refused("centroid_gain"):
        Kalman.load(path, PLANT)
