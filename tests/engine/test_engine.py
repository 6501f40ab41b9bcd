"""The engine between a pixel ring and its streams: every frame once and bit for bit."""

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
import pytest
from click.testing import CliRunner
from tests.engine.bench import SETTINGS, Bench, make, simulated
from tests.patience import LIMIT_S, wait_for
from tests.refusals import refused

import faintspot as fs
from faintspot.cli.realtime import command
from faintspot.engine.engine import Engine
from faintspot.engine.frames.pixel_ring import PixelRing
from faintspot.engine.frames.workers import PipelineMaker
from faintspot.engine.processes.requests import request, socket_path
from faintspot.engine.processes.segment import FOLDER
from faintspot.engine.request_handlers import commands_of
from faintspot.slopes.pipeline import configuration

pyshmem = pytest.importorskip("pyshmem")


pytestmark = pytest.mark.slow


def test_what_is_published(bench: Bench) -> None:
    """Slopes, details and marks, stamped with the frame's number; nobody else publishes under this name."""
    data = simulated(1)
    with refused(bench.name):
        Engine(bench.name, make, SETTINGS)
    expected = make(SETTINGS)(data[0])
    streams = {name: pyshmem.open(f"{bench.name}_{name}") for name in ("slopes", "details", "marks")}
    bench.measure(data, [17])
    found = {name: stream.read_publication() for name, stream in streams.items()}
    assert [publication.frame_id for publication in found.values()] == [17] * 3
    assert np.array_equal(found["slopes"].payload, expected.vector)
    assert np.array_equal(found["details"].payload[0], expected.flux)
    assert np.array_equal(found["details"].payload[4], expected.iterations)
    frame, method, change, last_row_ns, published_ns = found["marks"].payload.tolist()
    assert (frame, method, change) == (17, 0, 0)
    assert 0 < published_ns - last_row_ns < 60e9
    for stream in streams.values():
        stream.close()


NOTHING_IS_COMPILED_LATER = """
import gc, sys
import numpy as np
from numba.core.dispatcher import Dispatcher
from faintspot.loop.control.configuration import Control
from tests.engine.bench import Bench, simulated

def compiled():
    return {id(each): len(each.overloads) for each in gc.get_objects() if isinstance(each, Dispatcher)}

bench = Bench(control=Control(np.random.default_rng(1).standard_normal((32, 5))))
bench.engine.loop.close()
before = compiled()
for dtype in (np.uint16, np.float32):
    bench.measure(simulated(3).astype(dtype))
    bench.detached()
assert bench.engine.counters.processed == 6
bench.close()
sys.exit(compiled() != before)
"""


def test_it_is_ready_before_it_waits() -> None:
    """All that measures frames, of both types, and makes commands is compiled before the first frame."""
    ended = subprocess.run(
        [sys.executable, "-c", NOTHING_IS_COMPILED_LATER], check=False, timeout=5 * LIMIT_S
    )
    assert ended.returncode == 0


def test_frames_of_a_ring_that_was_waited_for_count(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames that are overwritten before the engine attaches are lost; the others are measured."""
    data, waits, wait = simulated(10), threading.Event(), bench.engine._await_ring

    def await_ring() -> None:
        waits.set()
        wait()

    monkeypatch.setattr(bench.engine, "_await_ring", await_ring)
    assert waits.wait(LIMIT_S)
    with bench.ring() as ring:
        for number, frame in enumerate(data):
            ring.publish(frame, number)
        bench.until(lambda: bench.engine.counters.frames_in == 10)
    counters = bench.engine.counters
    assert (counters.processed + counters.dropped, counters.skipped) == (10, 0)
    assert 9 in bench.slopes


def test_new_spots_are_measured_with_from_the_next_frame(bench: Bench, tmp_path: Path) -> None:
    """Slopes are those of a pipeline that has known them from the start."""
    layout, calibration = fs.Layout.grid((3, 3), pixels=10), fs.Calibration(100.0, read_noise_e=1.0)
    settings = fs.Settings("ml", flux_e=300.0)
    first, later = (fs.PSF.analytic("gaussian", size=size) for size in (1.0, 1.4))
    engine = Engine(f"spots_{uuid4().hex[:8]}", PipelineMaker(layout, calibration, first), settings)
    take = commands_of(engine)["spots"]
    path = tmp_path / "faintspot.toml"
    for item in (layout, calibration, settings):
        item.save(path)
    for file in (str(tmp_path / "none.toml"), 3, str(path)):  # the last has no PSF, which "ml" needs
        with pytest.raises(fs.InputError):
            take({"spots": file})
    assert engine.live.newest.pipelines[0].spot[0] is first
    configuration.save(path, later)
    take({"spots": str(path)})
    frame = np.random.default_rng(3).normal(110.0, 5.0, layout.frame_shape).astype(np.float32)
    expected = fs.SlopePipeline(layout, settings, calibration, psf=later)
    np.testing.assert_array_equal(engine.live.newest.pipelines[0](frame).vector, expected(frame).vector)
    engine._streams.close()
    engine._telemetry.close()


def test_a_source_that_goes_and_comes_back(bench: Bench) -> None:
    """It ends, it has another size, its file is removed: every frame is measured, once."""
    data = simulated(4)
    expected = make(SETTINGS)(data).vector
    bench.measure(data[:2], [0, 1])
    bench.detached()
    with bench.ring(shape=(64, 64)) as ring:
        bench.until(lambda: bench.engine.status()["source_refused"] is not None)
        ring.publish(np.zeros((64, 64), np.uint16))
        assert "64 x 64 pixels, uint16; expected 32 x 32" in bench.engine.status()["source_refused"]
    first = bench.ring()
    bench.attached()
    assert bench.engine.status()["source_refused"] is None
    bench.send(first, 2, data[2])
    (FOLDER / bench.name).unlink()
    bench.detached()
    bench.measure(data[3:], [3])
    bench.detached()
    first.close()
    assert bench.records["frame"].tolist() == [0, 1, 2, 3]
    np.testing.assert_array_equal([bench.slopes[number] for number in range(4)], expected)
    assert bench.engine.counters.source_restarts == 3


def test_overtaken_frames_are_dropped_never_mixed(bench: Bench) -> None:
    """A camera that does not wait: what is published belongs to one frame, the rest is counted."""
    data, n_frames = simulated(8), 2000
    expected = make(SETTINGS)(data).vector
    counters = bench.engine.counters
    with bench.ring() as ring:
        bench.attached()
        for number in range(n_frames):
            ring.publish(data[number % 8], number)
            if number % 100 == 0:
                bench.until(lambda number=number: counters.frames_in > number)
        bench.until(lambda: counters.processed + counters.dropped >= n_frames - 1)
    assert counters.dropped > 0
    lost = counters.torn + counters.passed_over
    assert counters.dropped == lost == sum(bench.engine.account.lost_because.values())
    records = bench.records
    assert counters.frames_in - counters.dropped == counters.processed == len(records)
    assert (np.diff(records["frame"]) > 0).all()
    for record in records:
        vector = np.concatenate([record["x"], record["y"]])
        assert np.array_equal(vector, expected[record["frame"] % 8])


def test_a_worker_dies(monkeypatch: pytest.MonkeyPatch) -> None:
    """One frame is dropped and counted; the thread is replaced and the loop goes on."""
    data = simulated(4)
    with Bench(threads=2) as bench:
        with bench.ring() as ring:
            bench.attached()
            bench.send(ring, 0, data[0])
            path = bench.engine._path
            work: Any = path._work  # type: ignore[union-attr]
            alive = [True]

            def deadly(share: int, *arguments: Any) -> bool:
                if share == 1 and alive:
                    alive.clear()
                    raise MemoryError
                return bool(work(share, *arguments))

            monkeypatch.setattr(path, "_work", deadly)
            for number in (1, 2, 3):
                bench.send(ring, number, data[number])
        counters = bench.engine.counters
        assert (counters.worker_restarts, counters.dropped) == (1, 1)
        assert np.array_equal(bench.slopes[3], make(SETTINGS)(data[3]).vector)


def test_settings_of_each_subaperture_change_while_frames_come(bench: Bench) -> None:
    """No frame is lost or mixed: each is that of the settings that its record names, bit for bit."""
    data, ended = simulated(8), threading.Event()
    proposed: list[dict[str, Any]] = [{}]

    def propose() -> None:
        rng = np.random.default_rng(2)
        while not ended.is_set():
            strength, limit = rng.uniform(0.5, 2.5, 16), rng.integers(1, 30, 16)
            values = {"noise_std": strength, "max_iterations": limit, "tolerance": rng.uniform(0, 0.01)}
            proposed.append(values)
            bench.engine.live.propose(values)

    proposer = threading.Thread(target=propose)
    with bench.ring() as ring:
        bench.attached()
        proposer.start()
        for number in range(150):
            bench.send(ring, number, data[number % 8])
        ended.set()
        proposer.join()
    records = bench.records
    assert records["frame"].tolist() == list(range(150))
    assert (np.diff(records["change"]) >= 0).all()
    assert len(np.unique(records["change"])) > 3  # some were overtaken by the next
    for record in records:
        settings = SETTINGS.replace(**proposed[record["change"]])
        expected = make(settings)(data[record["frame"] % 8]).vector
        np.testing.assert_array_equal(np.concatenate([record["x"], record["y"]]), expected)


CONFIGURATION = """
[layout.grid]
shape = [4, 4]
pixels = 8

[estimator]
name = "tv"
noise_std = 1.0
keep_brightest = 9

[calibration]
dark = 100.0
read_noise_e = 1.0
"""
COMMAND = [sys.executable, "-m", "faintspot", "realtime"]


@pytest.fixture
def processes(name: str, tmp_path: Path) -> Iterator[list[subprocess.Popen[bytes]]]:
    """Start an engine and recorded frames in place of a camera; end them."""
    (tmp_path / "faintspot.toml").write_text(CONFIGURATION)
    frames = np.random.default_rng(3).poisson(103.0, (50, 32, 32)).astype(np.uint16)
    np.save(tmp_path / "frames.npy", frames)
    camera = f"replay frames.npy --name {name} --frame-rate-hz 200 --repeat".split()
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    started = []
    for arguments in (["run", "--name", name], camera):
        with (tmp_path / f"{arguments[0]}.log").open("w") as log:
            started.append(
                subprocess.Popen([*COMMAND, *arguments], cwd=tmp_path, env=environment, stdout=log)
            )
    yield started
    for process in started:
        process.send_signal(signal.SIGINT)  # so that it removes its shared memory; nothing where it has ended
        try:
            process.wait(LIMIT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def counted(name: str) -> int:
    """Return how many frames the engine has measured; 0 while it starts and refuses to answer."""
    try:
        return int(request(socket_path(name), "status")["counters"]["processed"])
    except fs.InputError:
        return 0


def captured(name: str, count: int, first: int = 0) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Frames and slopes of the same number, from `first` on, as another process sees them."""
    stream, ring = pyshmem.open(f"{name}_slopes"), PixelRing.attach(name)
    found: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    def enough() -> bool:
        if stream.count:
            publication = stream.read_publication()
            number = publication.frame_id
            frame = ring.slot(number).copy()
            if ring.intact(number) and number >= first:
                found[number] = frame, np.array(publication.payload)
        return len(found) >= count

    wait_for(enough, "slopes")
    stream.close()
    return found


def test_camera_engine_and_client_work_as_processes(
    name: str, processes: list[subprocess.Popen[bytes]], tmp_path: Path
) -> None:
    wait_for(lambda: socket_path(name).exists(), "the engine")
    wait_for(lambda: counted(name) > 10, "frames")
    pipeline = fs.SlopePipeline.from_file(tmp_path / "faintspot.toml")
    for frame, slopes in captured(name, 30).values():
        assert np.array_equal(slopes, pipeline(frame).vector)

    said = CliRunner().invoke(command, ["send", "noise_std=2.5", "keep_brightest=5", "--name", name])
    first = int(said.output.rpartition("in effect from frame ")[2].split()[0])
    changed = fs.SlopePipeline(
        pipeline.layout, pipeline.settings.replace(noise_std=2.5, keep_brightest=5), pipeline.calibration
    )
    for frame, slopes in captured(name, 30, first).values():
        assert np.array_equal(slopes, changed(frame).vector)

    engine, camera = processes
    camera.send_signal(signal.SIGTERM)
    assert camera.wait(LIMIT_S) == 0
    assert not (FOLDER / name).exists()
    CliRunner().invoke(command, ["stop", "--name", name])
    assert engine.wait(LIMIT_S) == 0
    assert "frames measured" in (tmp_path / "run.log").read_text()
    assert not socket_path(name).exists()
