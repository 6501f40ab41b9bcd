"""Estimators and controllers take turns in a closed loop; what predicts tells estimators their prior."""

import threading
from dataclasses import replace
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
import pytest
from tests.refusals import refused
from tests.shared_data import skip_without

import faintspot as fs
from faintspot.engine.frames.workers import SlopePrior
from faintspot.engine.request_handlers import commands_of
from faintspot.engine.settings.interleaving import Interleaving
from faintspot.engine.streams.slope_streams import PredictionStream
from faintspot.loop.control.configuration import Control
from faintspot.loop.control.kalman.compiled import CompiledKalman
from faintspot.loop.simulation import Method, simulate_loop
from faintspot.slopes.pipeline import configuration as configuration_file

skip_without("hcipy")
pyshmem = pytest.importorskip("pyshmem")

from tests.engine.closed_loop import CONFIGURATION, Sky, configured, make_engine  # noqa: E402

pytestmark = pytest.mark.slow

EVERY, FRAMES = 8, 40
SHORT = CONFIGURATION.replace("control", telemetry_frames=300)
SETTINGS = fs.Settings("map", prior_std_px=1.0, flux_e=200.0)
METHODS = Interleaving.parse("window+integrator,map+kalman", EVERY)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Control]:
    return configured(tmp_path_factory.mktemp("bench"), SETTINGS, SHORT, "kalman")


def expected_std(control: Control) -> Any:
    """Return how sure the filter is of each sub-aperture's slopes [px]."""
    return np.sqrt(np.square(control.model.expected_std_px).reshape(2, -1).mean(axis=0))


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
    std = np.tile(expected_std(control), 2)
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
    # Other methods, while the loop is closed.
    sky.frames(2)
    commands_of(engine)["interleave"]({"methods": "set"})
    sky.frames(3)
    methods = sky.records["method"]
    assert (set(methods[:-5]), set(methods[-2:])) == ({0, 1}, {2})
    assert engine.loop_status()["controller"] == "kalman"
    assert set(sky.records["loop"]) == {2}
    with refused("interleave: 'window+integrator'", "makes no commands"):
        make_engine(f"{sky.name}_other", path, None, interleaving=METHODS)


def test_the_kalman_filter_s_loop_is_the_simulated_one(sky: Sky, files: tuple[Path, Control]) -> None:
    """Maximum a posteriori around what it predicts, as wide as it is sure; frame by frame, from files."""
    path, control = files
    run = SHORT.replace("run", frames=FRAMES, settle_frames=10)
    record = simulate_loop(run, [Method("-", SETTINGS, variants=("predicted",), control="kalman")])
    assert (control.prediction, control.options.centroid_gain) == ("controller", 1.0)
    told = SETTINGS.replace(prior_std_px=expected_std(control))  # for the first frame, too
    sky.start(make_engine(sky.name, path, control, settings=told))
    sky.loop.close()
    strehl = sky.frames(FRAMES)
    records = sky.records
    np.testing.assert_allclose(np.hstack([records["x"], records["y"]]), record.slopes_px, rtol=0, atol=2e-3)
    np.testing.assert_allclose(records["commands"][: FRAMES - 2], record.commands[2:], rtol=0, atol=0.5)
    np.testing.assert_allclose(strehl, record.strehl, rtol=0, atol=1e-3)
    assert strehl[20:].mean() > 0.3


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
    sure = expected_std(control)
    np.testing.assert_allclose(told[4:8], np.tile(sure, (4, 1)), rtol=1e-6)
    np.testing.assert_array_equal(told[:4] + told[8:], 1.0)
    assert sure.max() < 0.9


def test_predictions_from_a_stream(sky: Sky, files: tuple[Path, Control]) -> None:
    """Slopes are those of the pipeline with that prior, as wide as its variances say, if they say anything.

    Late, missing and impossible ones are counted, and nothing is expected.
    """
    path, known = files[0], files[1].with_controller("integrator")
    control = replace(known, options=known.options.replaced({"prediction": "stream"}))
    engine = make_engine(sky.name, path, control)
    sky.start(engine)
    prediction = engine._prediction
    assert prediction is not None
    seen = [sky.frame()]
    assert engine.status()["prediction"]["obstacle"] == "is not there"
    n = 36
    wrong = pyshmem.create(f"{sky.name}_prediction", shape=(3,), dtype=np.float64)
    sky.until(lambda: "holds (3,) float64, expected (145,)" in prediction.status()["obstacle"])
    wrong.unlink()
    sky.until(lambda: prediction.status()["obstacle"] == "is not there")
    stream = pyshmem.create(f"{sky.name}_prediction", shape=(4 * n + 1,), dtype=np.float64)
    sky.until(lambda: not prediction.status()["obstacle"])
    rng = np.random.default_rng(3)
    priors, widths, frames = [np.zeros(2 * n)], [np.ones(n)], [sky.pixels]
    variance = np.zeros(2 * n)
    for number, value in ((1, 0.0), (2, 0.0), (4, 0.0), (4, 1e9), (5, np.nan)):
        mean = rng.standard_normal(2 * n)
        mean[3] += value
        variance[:] = 0.04 * number
        variance[0], variance[n + 1], variance[2] = np.nan, -1.0, np.inf
        stream.write(np.concatenate([mean, variance, [number]]), frame_id=number)
        seen.append(sky.frame())
        frames.append(sky.pixels)
        taken = number == len(seen) - 1 and value == 0
        priors.append(mean if taken else np.zeros(2 * n))
        width = np.full(n, 0.2 * np.sqrt(number) if taken else 1.0)
        width[:3] = 1.0  # as the settings say
        widths.append(width)
    described = configuration_file.Configuration(path)
    for record, frame, prior, width in zip(sky.records, frames, priors, widths, strict=True):
        wide = described.settings.replace(prior_std_px=width)
        parts = described.layout, wide, described.calibration, control.reference
        pipeline = fs.SlopePipeline(*parts, psf=described.psf)
        expected = pipeline(frame, prior.astype(np.float32))
        np.testing.assert_array_equal(np.concatenate([record["x"], record["y"]]), expected.vector)
    counters = engine.status()["prediction"]
    assert (counters["taken"], counters["late"], counters["refused"]) == (2, 2, 2)
    stream.unlink()


def test_a_prediction_is_for_its_frame_and_its_writer_may_die() -> None:
    """Neither an older one, nor one for a later frame is taken. It looks for a stream again."""
    name = f"fs_test_{uuid4().hex[:12]}"
    prior = SlopePrior(2, 10.0)
    reader = PredictionStream(name, prior)
    reader.fill(0)
    assert not prior.mean_px.any()
    for _ in range(2):
        stream = pyshmem.create(f"{name}_prediction", shape=(9,), dtype=np.float32)
        reader.look_after()
        reader.fill(0)  # nothing was written yet
        stream.write(np.arange(9.0, dtype=np.float32), frame_id=8)
        reader.fill(8)
        np.testing.assert_array_equal(prior.mean_px.reshape(-1), [0.0, 1.0, 2.0, 3.0])
        np.testing.assert_allclose(prior.std_px, np.sqrt([5.0, 6.0]))  # of variances 4 and 6, 5 and 7
        for predicted in (8, 7, 0, -1, 10):
            stream.write(np.array([*np.ones(8), predicted], np.float32), frame_id=predicted % 2**32)
            reader.fill(9)
            assert not prior.mean_px.any()
        stream.unlink()
        reader.look_after()
        reader.fill(8)
        assert not prior.mean_px.any()
        assert np.isnan(prior.std_px).all()
    assert (reader.counters.restarts, reader.counters.taken, reader.counters.late) == (2, 2, 15)
    reader.close()


def test_a_stream_is_not_closed_while_it_is_read() -> None:
    """Closing unmaps its memory: the engine's thread would read what is no longer there."""

    class Removed:
        """A stream whose name leads nowhere, and which takes long to read."""

        count = 1

        def __init__(self) -> None:
            self.reading, self.go_on = threading.Event(), threading.Event()
            self.done: list[str] = []

        def same(self) -> None:
            return None

        def read(self, out: np.ndarray, limit_s: float) -> None:
            self.reading.set()
            self.go_on.wait(10.0)
            self.done.append("read")

        def close(self) -> None:
            self.done.append("closed")

    reader, removed = PredictionStream(f"fs_test_{uuid4().hex[:12]}", SlopePrior(2, 10.0)), Removed()
    reader._follower.source = removed  # type: ignore[assignment]
    engine = threading.Thread(target=reader.fill, args=(0,))
    engine.start()
    assert removed.reading.wait(10.0)
    watcher = threading.Thread(target=reader.look_after)
    watcher.start()
    watcher.join(0.05)
    assert not removed.done
    reader.fill(1)  # meanwhile it is neither read nor waited for
    removed.go_on.set()
    engine.join(10.0)
    watcher.join(10.0)
    assert removed.done == ["read", "closed"]
    assert reader.counters.late == 2


def test_the_mean_flux_is_told(sky: Sky, files: tuple[Path, Control]) -> None:
    """The star fades by three quarters: the settings follow."""
    path, control = files
    engine = make_engine(sky.name, path, control, mean_flux=20.0)
    sky.start(engine)
    sky.until(lambda: engine.live.change_number > 0 or sky.frame() is None)
    told = np.mean(engine.live.settings.flux_e)
    assert 60 < told < 250  # of 200 where a window has them all; speckled spots have less in theirs
    sky.telescope.order({"photons": 50.0})
    sky.until(lambda: np.mean(engine.live.settings.flux_e) < 0.4 * told or sky.frame() is None)
