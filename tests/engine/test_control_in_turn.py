"""Estimators and controllers take turns in a closed loop: no jump, and telemetry says whose turn it was."""

from pathlib import Path

import numpy as np
import pytest
from tests.refusals import refused
from tests.shared_data import skip_without

import faintspot as fs
from faintspot.engine.request_handlers import commands_of
from faintspot.engine.settings.interleaving import Interleaving
from faintspot.loop.control.configuration import Control
from faintspot.loop.control.kalman.compiled import CompiledKalman

pytest.importorskip("pyshmem")

from tests.engine.closed_loop import CONFIGURATION, Sky, configured, make_engine

skip_without("hcipy")

pytestmark = pytest.mark.slow

EVERY, FRAMES = 8, 40
SETTINGS = fs.Settings("map", prior_std_px=1.0, flux_e=200.0)
METHODS = Interleaving.parse("window+integrator,map+kalman", EVERY)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Control]:
    short = CONFIGURATION.replace("control", telemetry_frames=300)
    return configured(tmp_path_factory.mktemp("bench"), SETTINGS, short, "kalman")


def test_a_controller_goes_on_from_what_the_mirror_holds(sky: Sky, files: tuple[Path, Control]) -> None:
    path, control = files
    engine = make_engine(sky.name, path, control, interleaving=METHODS)
    sky.start(engine)
    sky.loop.close()
    strehl = sky.frames(FRAMES)
    records, sent = sky.records, sky.records["commands"].astype(np.float64)
    place = np.arange(FRAMES) // EVERY % 2
    assert records["method"].tolist() == place.tolist()
    assert engine.status()["methods"] == ["window+integrator", "map+kalman"]
    slopes, errors = (
        np.hstack([records[f"{name}{axis}"] for axis in "xy"]).astype(np.float64)
        for name in ("", "standard_error_")
    )
    invalid = np.tile(records["flags"] & 3 != 0, 2)
    slopes[invalid], errors[invalid] = 0.0, np.inf
    # The integrator's commands are those of the mirror's latest, whoever sent them.
    integrator = control.with_controller("integrator").options
    for frame in np.flatnonzero(place == 0)[1:]:
        step = control.reconstructor.matrix @ slopes[frame]
        expected = (1 - integrator.leak) * sent[frame - 1] - integrator.gain * step
        np.testing.assert_allclose(sent[frame], expected, rtol=0, atol=0.01)
    # The filter's are those of one that begins there.
    std = np.tile(np.sqrt(np.square(control.model.expected_std_px).reshape(2, -1).mean(axis=0)), 2)
    for first in range(EVERY, FRAMES, 2 * EVERY):
        line = control.line()
        for command in sent[first - 3 : first]:
            line.put(command)
        filtered = control.controller(line)
        assert isinstance(filtered, CompiledKalman)
        filtered.prior_std_px = std
        filtered.begin()
        for frame in range(first, first + EVERY):
            filtered.update(slopes[frame], errors[frame])
            np.testing.assert_allclose(sent[frame], line.latest, rtol=0, atol=0.1)
    # So the mirror moves no more when they change than it moves anyway.
    moved = np.sqrt(np.square(np.diff(sent, axis=0)).mean(axis=1))
    turns = np.arange(2 * EVERY, FRAMES, EVERY) - 1
    assert moved[turns].max() < 2 * np.delete(moved[EVERY:], turns - EVERY).max()
    assert strehl[20:].mean() > 0.25


def test_only_what_predicts_is_told_to_estimators(
    sky: Sky, files: tuple[Path, Control], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Beside the integrator, and in an open loop, the prior is that of the settings."""
    path, control = files
    engine = make_engine(
        sky.name, path, control, interleaving=Interleaving.parse("set+integrator,set+kalman", 4)
    )
    assert engine.loop is not None
    told, follow = [], engine.loop.follow

    def followed(slopes: fs.Slopes, number: int, prior_std_px: np.ndarray) -> np.ndarray:
        told.append(prior_std_px[:36].copy())
        return follow(slopes, number, prior_std_px)

    monkeypatch.setattr(engine.loop, "follow", followed)
    sky.start(engine)
    sky.loop.close()
    sky.frames(10)
    sky.loop.open()
    sky.frames(6)
    sure = np.sqrt(np.square(control.model.expected_std_px).reshape(2, -1).mean(axis=0))
    np.testing.assert_allclose(told[4:8], np.tile(sure, (4, 1)), rtol=1e-6)
    np.testing.assert_array_equal(told[:4] + told[8:], 1.0)
    assert sure.max() < 0.9


def test_methods_change_while_the_loop_is_closed(sky: Sky, files: tuple[Path, Control]) -> None:
    path, control = files
    engine = make_engine(sky.name, path, control)
    sky.start(engine)
    sky.loop.close()
    sky.frames(4)
    interleave = commands_of(engine)["interleave"]
    interleave({"methods": "window+integrator,map+kalman", "every": 2})
    sky.frames(6)
    assert commands_of(engine)["loop"]({"action": "gain", "gain": 0.125})["loop"]["gain"] == 0.125
    interleave({"methods": "set"})
    sky.frames(4)
    methods = sky.records["method"]
    assert set(methods[:4]) == {0}
    assert set(methods[5:-4]) == {1, 2}
    assert set(methods[-3:]) == {3}
    assert engine.loop_status()["controller"] == "kalman"
    assert set(sky.records["loop"]) == {2}


def test_without_commands_controllers_are_refused(sky: Sky, files: tuple[Path, Control]) -> None:
    with refused("interleave: 'window+integrator'", "makes no commands"):
        make_engine(sky.name, files[0], None, interleaving=METHODS)
