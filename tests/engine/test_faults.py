"""What cameras, consumers and clocks do wrong: the loop goes on, and says what happened."""

import os
import signal
import threading
import time
from typing import Any

import numpy as np
import pytest
from tests.engine.bench import SETTINGS, Bench, make, simulated
from tests.engine.commands import start

from faintspot.engine.processes.segment import FOLDER

pyshmem = pytest.importorskip("pyshmem")

pytestmark = pytest.mark.slow


def test_overtaken_frames_are_dropped_never_mixed(bench: Bench) -> None:
    """A camera that does not wait: what is published belongs to one frame, the rest is counted."""
    data = simulated(8)
    expected = make(SETTINGS)(data).vector
    n_frames = 3000
    with bench.ring() as ring:
        bench.attached()
        for number in range(n_frames):
            ring.publish(data[number % 8], number)
            if number % 50 == 0:
                time.sleep(0.002)  # so that some are measured
        counters = bench.engine.counters
        bench.until(lambda: counters.processed + counters.dropped >= n_frames - 1)
    assert counters.dropped > 0
    assert counters.frames_in == counters.processed + counters.dropped
    assert (
        counters.dropped
        == counters.torn + counters.passed_over
        == sum(bench.engine.account.lost_because.values())
    )
    records = bench.records
    assert len(records) == counters.processed
    assert (np.diff(records["frame"]) > 0).all()
    for record in records:
        vector = np.concatenate([record["x"], record["y"]])
        assert np.array_equal(vector, expected[record["frame"] % 8])


def test_nan_and_saturated_pixels() -> None:
    """Flagged as offline; NaN never comes out."""
    data = simulated(3).astype(np.float32)
    data[0, 3] = np.nan
    data[1] = 65535.0
    data[2, :8, :8] = np.inf
    expected = make(SETTINGS)(data)
    with Bench() as bench:
        bench.measure(data)
        records = bench.records
    assert np.array_equal(records["flags"], expected.flags)
    assert np.array_equal(records["x"], expected.x)
    assert np.isfinite(records["x"]).all()


def test_frame_size_changes_and_comes_back(bench: Bench) -> None:
    data = simulated(2)
    bench.measure(data[:1])
    bench.detached()
    with bench.ring(shape=(64, 64)) as ring:
        bench.until(lambda: bench.engine.status()["source_refused"] is not None)
        ring.publish(np.zeros((64, 64), np.uint16))
        assert "64 x 64 pixels, uint16; expected 32 x 32" in bench.engine.status()["source_refused"]
    bench.measure(data[1:], [1])
    assert np.array_equal(bench.slopes[1], make(SETTINGS)(data[1]).vector)
    assert bench.engine.status()["source_refused"] is None


def test_input_deleted_and_made_anew(bench: Bench) -> None:
    data = simulated(2)
    first = bench.ring()
    bench.attached()
    bench.send(first, 0, data[0])
    (FOLDER / bench.name).unlink()
    bench.detached()
    with bench.ring() as second:
        bench.attached()
        bench.send(second, 0, data[1])
    first.close()
    assert bench.engine.counters.source_restarts == 1
    assert np.array_equal(bench.slopes[0], make(SETTINGS)(data[1]).vector)


def test_a_consumer_that_hangs(bench: Bench) -> None:
    """One is stopped by force while it reads: neither the engine nor other consumers notice."""
    data = simulated(8)
    program = (
        f"import pyshmem\ns = pyshmem.open('{bench.name}_slopes')\nprint('ready', flush=True)\n"
        "while True: s.count and s.read_publication()"
    )
    with bench.ring() as ring, start(program) as consumer:
        assert consumer.stdout is not None
        consumer.stdout.readline()
        bench.attached()
        bench.send(ring, 0, data[0])
        os.kill(consumer.pid, signal.SIGSTOP)
        for number in range(1, 8):
            bench.send(ring, number, data[number])
        os.kill(consumer.pid, signal.SIGKILL)
    assert bench.engine.counters.processed == 8


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
        assert counters.worker_restarts == 1
        assert counters.dropped == 1
        assert np.array_equal(bench.slopes[3], make(SETTINGS)(data[3]).vector)


def test_a_hundred_changes_a_second_under_load(bench: Bench) -> None:
    """No frame is lost or mixed: each is that of the settings that its record names, bit for bit."""
    data = simulated(8)
    seconds, rate_hz = 1.5, 400
    strengths = np.linspace(0.5, 2.5, 16)
    sending = threading.Event()
    sending.set()

    def send() -> None:
        with bench.ring() as ring:
            bench.attached()
            start = time.monotonic()
            for number in range(int(seconds * rate_hz)):
                while time.monotonic() < start + number / rate_hz:
                    time.sleep(0.0002)
                ring.publish(data[number % 8], number)
            bench.until(lambda: bench.engine.counters.frames_in >= seconds * rate_hz)
        sending.clear()

    camera = threading.Thread(target=send)
    camera.start()
    bench.attached()
    proposed = [SETTINGS.noise_std]
    while sending.is_set():
        strength = float(strengths[len(proposed) % 16])
        bench.engine.live.propose({"noise_std": strength, "keep_brightest": 4 + len(proposed) % 5})
        proposed.append(strength)
        time.sleep(0.01)
    camera.join()
    records, counters = bench.records, bench.engine.counters
    assert counters.processed + counters.dropped == seconds * rate_hz
    assert (np.diff(records["change"]) >= 0).all()
    assert len(np.unique(records["change"])) > 3  # of them, some were overtaken by the next
    for record in records:
        change = int(record["change"])
        changes = {"noise_std": proposed[change], "keep_brightest": 4 + change % 5} if change else {}
        frame = data[record["frame"] % 8]
        expected = make(SETTINGS.replace(**changes))(frame).vector
        assert np.array_equal(np.concatenate([record["x"], record["y"]]), expected)
