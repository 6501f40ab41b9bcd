"""The engine between a pixel ring and its streams: every frame once and bit for bit."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from typing import Any
from uuid import uuid4

import numpy as np
import pytest
from numpy.typing import NDArray

import faintspot as fs
from faintspot.realtime.engine import Engine
from faintspot.realtime.pixel_ring import PixelRing

pyshmem = pytest.importorskip("pyshmem")

LAYOUT = fs.Layout.grid((4, 4), pixels=8)
CALIBRATION = fs.Calibration(100.0, read_noise_e=1.0)
SETTINGS = fs.Settings(noise_std=1.0, keep_brightest=9)
PATIENCE_S = 20.0


def make(settings: fs.Settings) -> fs.SlopePipeline:
    return fs.SlopePipeline(LAYOUT, settings, CALIBRATION)


def simulated(n: int) -> NDArray[np.uint16]:
    frames, _ = fs.simulate.sensor_frames(
        LAYOUT.corners,
        LAYOUT.window,
        LAYOUT.frame_shape,
        n,
        flux_e=300.0,
        detector=fs.simulate.Detector(1.0, offset_adu=100.0, bits=16),
        rng=np.random.default_rng(8),
    )
    return np.asarray(frames, np.uint16)


class Bench:
    """An engine that runs in a thread, with what it publishes."""

    def __init__(self) -> None:
        self.name = f"fs_test_{uuid4().hex[:12]}"
        self.engine = Engine(self.name, make, SETTINGS)
        self.slopes: dict[int, NDArray[np.float32]] = {}
        self._thread = threading.Thread(target=self.engine.run)
        self._stream = pyshmem.open(f"{self.name}_slopes")
        self._thread.start()

    def ring(self) -> PixelRing:
        return PixelRing.create(self.name, LAYOUT.frame_shape, np.uint16)

    def until(self, condition: Any) -> None:
        end = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < end, self.engine.status()
            time.sleep(0.001)

    def attached(self) -> None:
        self.until(lambda: self.engine._waiting_for >= 0)

    def send(self, ring: PixelRing, number: int, frame: NDArray[Any], rows: int = 5) -> None:
        """Send a frame row by row and collect its slopes."""
        slot = ring.begin(number)
        for row in range(0, len(frame), rows):
            slot[row : row + rows] = frame[row : row + rows]
            ring.rows_ready(min(row + rows, len(frame)))
        ring.end()
        self.collect(number)

    def collect(self, number: int) -> None:
        def there() -> bool:
            if self._stream.count == 0:
                return False
            publication = self._stream.read_publication()
            self.slopes[publication.frame_id] = np.array(publication.payload)
            return bool(publication.frame_id == number)

        self.until(there)

    def close(self) -> None:
        self.engine.stop()
        self._thread.join(PATIENCE_S)
        assert not self._thread.is_alive()
        self._stream.close()


@pytest.fixture
def bench() -> Iterator[Bench]:
    bench = Bench()
    yield bench
    bench.close()


def test_every_frame_is_published_once_and_bit_for_bit(bench: Bench) -> None:
    data = simulated(6)
    expected = make(SETTINGS)(data).vector
    with bench.ring() as ring:
        bench.attached()
        for number, frame in enumerate(data):
            bench.send(ring, number, frame)
    assert all(np.array_equal(bench.slopes[number], expected[number]) for number in range(6))
    counters = bench.engine.counters
    assert (counters.processed, counters.dropped, counters.skipped) == (6, 0, 0)
    assert bench.engine.latencies.count == 6


def test_settings_change_between_two_frames(bench: Bench) -> None:
    data = simulated(4)
    other = SETTINGS.replace(noise_std=2.5, keep_brightest=5)
    with bench.ring() as ring:
        bench.attached()
        bench.send(ring, 0, data[0])
        bench.send(ring, 1, data[1])
        change = bench.engine.live.propose({"noise_std": 2.5, "keep_brightest": 5})
        bench.send(ring, 2, data[2])  # was waited for already when the change was proposed, or not
        bench.send(ring, 3, data[3])
    at = bench.engine.live.frame_of(change)
    assert at in (2, 3)
    for number, frame in enumerate(data):
        settings = other if number >= at else SETTINGS
        assert np.array_equal(bench.slopes[number], make(settings)(frame).vector), number


def test_an_invalid_change_is_refused_whole(bench: Bench) -> None:
    with pytest.raises(fs.InputError, match="noise_std = -1"):
        bench.engine.live.propose({"keep_brightest": 5, "noise_std": -1.0})
    assert bench.engine.live.settings == SETTINGS


def test_source_restarts(bench: Bench) -> None:
    data = simulated(2)
    expected = make(SETTINGS)(data).vector
    for start in (0, 100):
        with bench.ring() as ring:
            bench.attached()
            bench.send(ring, start, data[0])
            bench.send(ring, start + 1, data[1])
        bench.until(lambda: bench.engine._waiting_for < 0)
    for start in (0, 100):
        assert np.array_equal(bench.slopes[start + 1], expected[1])
    assert bench.engine.counters.source_restarts == 2


def test_numbers_are_skipped_and_begin_anew(bench: Bench) -> None:
    data = simulated(3)
    expected = make(SETTINGS)(data).vector
    with bench.ring() as ring:
        bench.attached()
        bench.send(ring, 10, data[0])
        bench.send(ring, 12, data[1])  # 11 never comes
        assert bench.engine.counters.skipped >= 1
        ring.begin(0)[:] = data[2]
        ring.end()
        bench.until(lambda: bench.engine._waiting_for == 1)
        bench.send(ring, 1, data[2])
    assert np.array_equal(bench.slopes[12], expected[1])
    assert np.array_equal(bench.slopes[1], expected[2])


def test_a_living_publisher_is_not_replaced(bench: Bench) -> None:
    with pytest.raises(fs.InputError, match="a living process publishes under this name"):
        Engine(bench.name, make, SETTINGS)
