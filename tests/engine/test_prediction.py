"""What estimators are told: a prior, from the engine's controller or from outside, and the mean flux."""

import threading
import time
from dataclasses import replace
from pathlib import Path
from uuid import uuid4

import numpy as np
import pytest
from tests.shared_data import skip_without

import faintspot as fs
from faintspot.engine.frames.workers import SlopePrior
from faintspot.engine.streams.slope_streams import PredictionStream
from faintspot.loop.control.configuration import Control
from faintspot.loop.simulation import Method, simulate_loop
from faintspot.loop.simulation.learning import learnt_control
from faintspot.slopes.pipeline import configuration as configuration_file

skip_without("hcipy")
pyshmem = pytest.importorskip("pyshmem")

from tests.engine.closed_loop import CONFIGURATION, Sky, configured, make_engine  # noqa: E402

pytestmark = pytest.mark.slow

FRAMES = 40
SETTINGS = fs.Settings("map", prior_std_px=1.0, flux_e=200.0)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Control]:
    return configured(tmp_path_factory.mktemp("bench"), SETTINGS)


def test_the_kalman_filter_s_loop_is_the_simulated_one(sky: Sky, tmp_path: Path) -> None:
    """Maximum a posteriori around what it predicts, as wide as it is sure; frame by frame, from files."""
    run = CONFIGURATION.replace("control", telemetry_frames=300)
    run = run.replace("run", frames=FRAMES, settle_frames=10)
    path, control = configured(tmp_path, SETTINGS, run, "kalman")
    assert (control.prediction, control.options.centroid_gain) == ("controller", 1.0)
    method = Method("-", SETTINGS, variants=("predicted",), control="kalman")
    told, _ = learnt_control(
        run, method, run.run.seed, simulate_loop
    )  # the first frame's prior, too, is as wide
    record = simulate_loop(run, [method])
    sky.start(make_engine(sky.name, path, control, settings=told.settings))
    sky.loop.close()
    strehl = sky.frames(FRAMES)
    records = sky.records
    np.testing.assert_allclose(np.hstack([records["x"], records["y"]]), record.slopes_px, rtol=0, atol=2e-3)
    np.testing.assert_allclose(records["commands"][: FRAMES - 2], record.commands[2:], rtol=0, atol=0.5)
    np.testing.assert_allclose(strehl, record.strehl, rtol=0, atol=1e-3)
    assert strehl[20:].mean() > 0.3


def test_predictions_from_a_stream(sky: Sky, files: tuple[Path, Control]) -> None:
    """Slopes are those of the pipeline with that prior, as wide as its variances say, if they say anything.

    Late, missing and impossible ones are counted, and nothing is expected.
    """
    path, known = files
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


def test_a_prediction_s_writer_may_die() -> None:
    """It looks for the stream again, and never raises."""
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
        stream.unlink()
        reader.look_after()
        reader.fill(8)
        assert not prior.mean_px.any()
        assert np.isnan(prior.std_px).all()
    assert reader.counters.restarts == 2
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

    reader = PredictionStream(f"fs_test_{uuid4().hex[:12]}", SlopePrior(2, 10.0))
    removed = Removed()
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


def test_a_prediction_for_another_frame_is_not_taken() -> None:
    """Neither the last one again, nor an older one, nor one for a later frame."""
    name = f"fs_test_{uuid4().hex[:12]}"
    prior = SlopePrior(2, 10.0)
    stream = pyshmem.create(f"{name}_prediction", shape=(9,), dtype=np.float64)
    reader = PredictionStream(name, prior)
    for late, predicted in enumerate((8, 7, 0, -1, 10)):
        for number, taken in ((8, predicted == 8), (9, False)):
            stream.write(np.array([*np.ones(8), predicted]), frame_id=predicted % 2**32)
            reader.fill(number)
            assert prior.mean_px.any() == taken
        assert reader.counters.late == 2 * late + 1
    assert reader.counters.taken == 1
    stream.unlink()
    reader.close()


def test_the_mean_flux_is_told(sky: Sky, files: tuple[Path, Control]) -> None:
    """The star fades by three quarters: the settings follow."""
    path, control = files
    engine = make_engine(sky.name, path, control, mean_flux=20.0)
    sky.start(engine)
    sky.frames(25)
    sky.until(lambda: engine.live.change_number > 0 or sky.frame() is None)
    told = np.mean(engine.live.settings.flux_e)
    assert 60 < told < 250  # of 200 where a window has them all; speckled spots have less in theirs
    sky.telescope.order({"photons": 50.0})
    sky.frames(60)
    sky.until(lambda: np.mean(engine.live.settings.flux_e) < 0.4 * told or sky.frame() is None)


def test_estimators_that_do_not_use_the_flux_are_left_alone(
    sky: Sky, files: tuple[Path, Control], tmp_path: Path
) -> None:
    path = tmp_path / "faintspot.toml"
    path.write_text(files[0].read_text())
    (tmp_path / "faintspot.psf.npz").write_bytes((files[0].parent / "faintspot.psf.npz").read_bytes())
    engine = make_engine(sky.name, path, None, settings=fs.Settings("brightest"), mean_flux=5.0)
    sky.start(engine)
    sky.frames(10)
    time.sleep(0.3)
    assert engine.live.change_number == 0
