"""The bridge from a stream to a pixel ring: every frame whole, and all that can happen to a stream."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from tests.engine.commands import needs_shared_memory
from tests.patience import wait_for
from tests.refusals import refused

from faintspot.engine.frames.pixel_ring import PixelRing
from faintspot.engine.streams.bridge import BridgeCounters, StreamBridge

pyshmem = pytest.importorskip("pyshmem")
pytestmark = [needs_shared_memory, pytest.mark.slow]
SHAPE = (6, 5)


class Running:
    """A bridge in a thread, and what it said."""

    def __init__(self, name: str, spins: bool | None = None) -> None:
        self.lines: list[str] = []
        self.stop = threading.Event()
        self.bridge = StreamBridge(f"{name}_in", name, say=self.lines.append, spins=spins)
        self.error: BaseException | None = None
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        try:
            self.bridge.run(None, self.stop)
        except BaseException as error:
            self.error = error

    @property
    def counters(self) -> BridgeCounters:
        return self.bridge.counters

    def said(self, text: str) -> None:
        wait_for(lambda: any(text in line for line in self.lines), f"{text!r} in {self.lines}")

    def end(self) -> None:
        self.stop.set()
        self._thread.join()


@pytest.fixture
def running(name: str, request: pytest.FixtureRequest) -> Iterator[Running]:
    made = Running(name, getattr(request, "param", None))
    yield made
    made.end()
    if made.error is not None:
        raise made.error


def frame(number: int, dtype: Any = np.uint16, shape: tuple[int, int] = SHAPE) -> np.ndarray:
    return np.random.default_rng(number).integers(0, 120, shape).astype(dtype)


def created(name: str, dtype: Any = np.uint16, shape: tuple[int, int] = SHAPE, **options: Any) -> Any:
    return pyshmem.create(f"{name}_in", shape=shape, dtype=dtype, **options)


@pytest.fixture
def stream(name: str, running: Running) -> Iterator[Any]:
    """A stream of the usual frames, which the bridge has found."""
    made = created(name)
    running.said("6 x 5 pixels")
    yield made
    made.unlink()


@pytest.mark.parametrize(
    ("running", "dtype", "notify"),
    [(False, "uint16", True), (True, "uint16", False), (False, "float64", False)],
    indirect=["running"],
)
def test_frames_of_a_stream_arrive_in_the_ring(name: str, running: Running, dtype: str, notify: bool) -> None:
    running.said("is not there; waiting")
    stream = created(name, dtype, notify=notify)
    running.said("6 x 5 pixels")
    ring = PixelRing.attach(name)
    assert ring.dtype == (np.uint16 if dtype == "uint16" else np.float32)
    for count, number in enumerate((0, 1, 2, 7, 7, 2**40, 3), start=1):  # the producer's
        sent = frame(number, dtype)
        if dtype == "float64":
            sent[0, 0], sent[1, 1] = np.nan, 1e300
        stream.write(sent, frame_id=number)
        wait_for(lambda count=count: ring.arrivals == count and ring.progress()[1] == 6)
        assert ring.progress() == (number, 6)
        with np.errstate(over="ignore"):
            np.testing.assert_array_equal(ring.slot(number), sent.astype(ring.dtype))
    assert (running.counters.taken, running.counters.missed, running.counters.not_ahead) == (7, 0, 2)
    stream.unlink()


def test_what_it_is_too_slow_for_is_counted(name: str, running: Running) -> None:
    """Written at full speed: what arrives is whole and carries its number, the others are counted."""
    stream = created(name, shape=(200, 200))
    running.said("200 x 200 pixels")
    ring = PixelRing.attach(name)
    for number in range(1, 401):
        stream.write(np.full((200, 200), number, np.uint16), frame_id=number)
        newest = ring.progress()[0]
        if newest > 0 and ring.last_row_time_ns(newest):
            pixels = ring.slot(newest).copy()
            if ring.intact(newest) and ring.last_row_time_ns(newest):
                assert np.all(pixels == newest)
    wait_for(lambda: ring.last_row_time_ns(400))
    wait_for(lambda: running.counters.taken + running.counters.missed == 400, str(running.counters))
    assert running.counters.not_ahead == 0
    stream.unlink()


def test_a_stream_that_is_made_anew(name: str, running: Running) -> None:
    """Same size: the ring stays. Another one: a new ring of the same name."""
    first = created(name)
    running.said("6 x 5 pixels")
    ring = PixelRing.attach(name)
    first.write(frame(1))
    wait_for(lambda: ring.last_row_time_ns(0))
    first.unlink()
    running.said("was removed")
    second = created(name)
    wait_for(lambda: sum("6 x 5 pixels" in line for line in running.lines) == 2)
    second.write(frame(2))
    wait_for(lambda: ring.arrivals == 2)
    wait_for(lambda: ring.last_row_time_ns(0))
    np.testing.assert_array_equal(ring.slot(0), frame(2))
    second.unlink()
    third = created(name, np.float32, (4, 8))
    running.said("4 x 8 pixels")
    assert ring.closed
    again = PixelRing.attach(name)
    assert again.shape == (4, 8)
    assert again.dtype == np.float32
    third.write(frame(3, np.float32, (4, 8)))
    wait_for(lambda: again.last_row_time_ns(0))
    assert running.counters.restarts == 2
    third.unlink()


def _die_while_writing(name: str, ready: Any) -> None:
    stream = pyshmem.create(f"{name}_in", shape=SHAPE, dtype=np.uint16)
    ready.wait()
    stream.write(frame(0))
    ready.wait()
    with stream.write_view() as view:
        view[0] = 9
        os.kill(os.getpid(), signal.SIGKILL)


def test_a_producer_that_dies_while_it_writes(name: str, running: Running) -> None:
    """The frame that is torn is never shown; a successor goes on in the same stream."""
    context = multiprocessing.get_context("spawn")
    ready = context.Barrier(2)
    producer = context.Process(target=_die_while_writing, args=(name, ready))
    producer.start()
    running.said("6 x 5 pixels")
    ring = PixelRing.attach(name)
    ready.wait()
    wait_for(lambda: ring.last_row_time_ns(0))
    ready.wait()
    producer.join()
    running.said("which made it, has ended")
    assert ring.progress()[0] == 0
    successor = pyshmem.open(f"{name}_in")
    successor.write(frame(5))
    wait_for(lambda: ring.last_row_time_ns(1))
    np.testing.assert_array_equal(ring.slot(1), frame(5))
    successor.unlink()


def test_the_ring_belongs_to_somebody_else(name: str) -> None:
    stream = created(name)
    with PixelRing.create(name, SHAPE, np.uint16), refused(name):
        StreamBridge(f"{name}_in", name).run()
    stream.unlink()
    with refused("n_frames = 0"):
        StreamBridge(f"{name}_in", name).run(0)
