"""The engine between a pixel ring and its streams: every frame once and bit for bit."""

import io
import os
import subprocess
import sys
import threading
from pathlib import Path
from uuid import uuid4

import numpy as np
import pytest
from rich.console import Console
from tests.engine.bench import SETTINGS, Bench, make, simulated
from tests.patience import LIMIT_S
from tests.refusals import refused

import faintspot as fs
from faintspot.cli.realtime import control as realtime_control
from faintspot.engine.engine import Engine
from faintspot.engine.frames.readout import Replay
from faintspot.engine.frames.workers import PipelineMaker
from faintspot.engine.request_handlers import commands_of
from faintspot.engine.streams.bridge import StreamBridge
from faintspot.io import open_frames
from faintspot.slopes.pipeline import configuration

pyshmem = pytest.importorskip("pyshmem")

pytestmark = pytest.mark.slow


def test_what_is_published(bench: Bench) -> None:
    """Slopes, details and marks, stamped with the frame's number."""
    data = simulated(1)
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


def test_restarted_source_loses_no_frame(bench: Bench) -> None:
    data = simulated(2)
    expected = make(SETTINGS)(data).vector
    for start in (0, 100):
        bench.measure(data, [start, start + 1])
        bench.detached()
    for start in (0, 100):
        assert np.array_equal(bench.slopes[start + 1], expected[1])
    assert bench.engine.counters.source_restarts == 2


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


def test_a_living_publisher_is_not_replaced(bench: Bench) -> None:
    with refused(bench.name):
        Engine(bench.name, make, SETTINGS)


def test_frames_of_a_stream() -> None:
    """The engine follows a pyshmem stream itself, also when it comes back with another size."""
    data = simulated(4)
    expected = make(SETTINGS)(data).vector
    name = f"fs_test_{uuid4().hex[:12]}"
    with Bench(f"{name}_ring", source=StreamBridge(name, f"{name}_ring")) as bench:
        for shape in (data.shape[1:], (64, 64), data.shape[1:]):
            stream = pyshmem.create(name, shape=shape, dtype=np.uint16)
            if shape != data.shape[1:]:
                bench.until(lambda: bench.engine.status()["source_refused"] is not None)
            else:
                sent = bench.engine.counters.processed
                for number in (1, 2, 3):
                    while bench.engine.counters.processed == sent:  # the first ones come before it looks
                        stream.write(data[number], frame_id=number)
                        bench.until(lambda: True)
                    sent = bench.engine.counters.processed
            stream.close()
            pyshmem.unlink(name)
        assert bench.engine.counters.processed >= 6
        assert np.array_equal(bench.slopes[3], expected[3])


def test_recorded_frames_give_the_slopes_that_they_give_offline(bench: Bench, tmp_path: Path) -> None:
    """Replayed row by row, much faster than it measures: every frame, as the pipeline measures it."""
    data = simulated(20)
    data[5:10, 8:16, 8:16] = np.roll(data[5:10, 8:16, 8:16], 3, axis=2)  # a spot off its place
    np.save(tmp_path / "frames.npy", data)
    with (
        open_frames([tmp_path / "frames.npy"]) as source,
        bench.ring() as ring,
        Replay(source, ring, frame_rate_hz=1e5, rows_per_block=5, waits=True) as player,
    ):
        assert (player.run().frames, player.lost) == (20, 0)
    bench.detached()
    expected, records = make(SETTINGS)(data), bench.records
    assert expected.flags[5, 5] & fs.SubapertureFlag.UNLIKE_NEIGHBOURS
    assert records["frame"].tolist() == list(range(20))
    for record in records:
        for name in ("x", "y", "flux", "flags", "iterations", "standard_error_x"):
            assert np.array_equal(record[name], getattr(expected, name)[record["frame"]]), name


def test_the_terminal_shows_the_status(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    data = simulated(1)
    with bench.ring() as ring:
        bench.attached()
        bench.send(ring, 0, data[0])
        monkeypatch.setattr(realtime_control, "asked", lambda name, what: bench.engine.status())
        console = Console(width=100, record=True, file=io.StringIO())
        console.print(realtime_control._table(bench.name))
    text = console.export_text()
    mean = make(SETTINGS)(data[0]).iterations.mean()
    assert f"{mean:.1f}" in next(line for line in text.splitlines() if "iterations a sub-aperture" in line)
    assert "latency p99.9, us" in text
    assert f"process {os.getpid()}, frame 0" in text


def test_new_spots_are_measured_with_from_the_next_frame(tmp_path: Path) -> None:
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


def test_an_engine_of_other_pipelines_refuses_new_spots(bench: Bench, tmp_path: Path) -> None:
    with pytest.raises(fs.InputError, match="pipelines"):
        commands_of(bench.engine)["spots"]({"spots": str(tmp_path / "faintspot.toml")})
