"""A read-out publishes its frames in order, row by row, at its rate; it stops and ends."""

import threading
import time
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.engine.commands import needs_shared_memory
from tests.refusals import assert_each_refused, refused

from faintspot.engine.frames import readout
from faintspot.engine.frames.pixel_ring import PixelRing
from faintspot.engine.frames.readout import Readout, readout_type
from faintspot.slopes.simulate import Detector

pytestmark = [needs_shared_memory, pytest.mark.slow]

SHAPE = 24, 32


@pytest.fixture
def ring(name: str) -> Iterator[PixelRing]:
    with PixelRing.create(name, SHAPE, np.float32, slots=8) as made:
        yield made


class Cycle(Readout):
    """Five frames, again and again."""

    def __init__(self, ring: PixelRing, rate: float = 1000.0, **options: Any) -> None:
        super().__init__(ring, SHAPE, np.dtype(np.float32), **{"frame_rate_hz": rate, **options})
        self.frames = np.random.default_rng(3).normal(size=(5, *SHAPE)).astype(np.float32)

    def _frame(self) -> NDArray[np.generic]:
        frame: NDArray[np.generic] = self.frames[self._next % len(self.frames)]
        return frame


def test_frames_are_published_in_order(ring: PixelRing) -> None:
    source = Cycle(ring)
    reader = PixelRing.attach(ring.name)
    for number in range(12):
        assert source.run(1).frames == 1
        assert reader.progress() == (number, SHAPE[0])
        np.testing.assert_array_equal(reader.slot(number), source.frames[number % 5])
    assert source.run(7).frames == 7  # the slots hold the last eight
    for number in range(11, 19):
        assert reader.intact(number)
        np.testing.assert_array_equal(reader.slot(number), source.frames[number % 5])


@pytest.mark.parametrize("rows_per_block", [1, 5, 24])
def test_rows_come_in_blocks(ring: PixelRing, rows_per_block: int, monkeypatch: pytest.MonkeyPatch) -> None:
    source, seen = Cycle(ring, rows_per_block=rows_per_block), []
    said = PixelRing.rows_ready

    def watched(self: PixelRing, rows: int) -> None:
        said(self, rows)
        seen.append(self.progress())
        frame = source.frames[self.progress()[0]]
        np.testing.assert_array_equal(self.slot(seen[-1][0])[:rows], frame[:rows])

    monkeypatch.setattr(PixelRing, "rows_ready", watched)
    source.run(2)
    steps = [*range(rows_per_block, 24, rows_per_block), 24]
    assert seen == [(number, rows) for number in range(2) for rows in steps]


def test_numbers_and_rows_only_go_forward(ring: PixelRing) -> None:
    source, stop = Cycle(ring, rate=300.0), threading.Event()
    seen: list[tuple[int, int]] = []
    runner = threading.Thread(target=source.run, args=(None, stop))
    runner.start()
    reader = PixelRing.attach(ring.name)
    while runner.is_alive() and (not seen or seen[-1][0] < 30):
        progress = reader.progress()
        if not seen or progress != seen[-1]:
            seen.append(progress)
        time.sleep(1e-4)
    stop.set()
    runner.join()
    # Between two frames the old number with no rows may be seen for an instant.
    ahead = [progress for progress in seen if progress[1] > 0]
    assert ahead == sorted(ahead)
    assert seen[-1][0] >= 30
    assert ring.progress() == (ring.arrivals - 1, 24)


def test_frames_come_at_the_rate_asked_for(ring: PixelRing) -> None:
    """Within 20 % of the schedule, frame times that other work on the machine took away counted in."""
    report = Cycle(ring, rate=200.0).run(100)
    assert report.frames == 100
    assert report.frame_rate_hz == pytest.approx(report.frames / report.seconds)
    assert (report.frames + report.overruns) / report.seconds == pytest.approx(200.0, rel=0.2)


def test_overruns_are_counted_and_left_behind(ring: PixelRing, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a clock of its own, where each frame takes 2.5 frame times."""
    now = [0]

    def publish(self: Cycle, moment: int, frame: object) -> None:
        assert now[0] >= moment
        starts.append(now[0])
        now[0] += 25_000_000 if len(starts) <= 3 else 1_000_000

    def wait_until(moment: int, spins: bool) -> None:
        now[0] = max(now[0], moment)

    starts: list[int] = []
    source = Cycle(ring, rate=100.0)
    monkeypatch.setattr(time, "monotonic_ns", lambda: now[0])
    monkeypatch.setattr(readout, "_wait_until", wait_until)
    monkeypatch.setattr(Cycle, "_publish", publish)
    report = source.run(6)
    assert starts == [0, 25_000_000, 50_000_000, 75_000_000, 80_000_000, 90_000_000]
    assert (report.frames, report.overruns, report.seconds) == (6, 4, 0.1)


def test_stop_before_the_first_frame(ring: PixelRing) -> None:
    stop = threading.Event()
    stop.set()
    report = Cycle(ring).run(None, stop)
    assert (report.frames, report.overruns, report.frame_rate_hz) == (0, 0, 0.0)
    assert ring.progress() == (-1, 0)


@pytest.mark.parametrize(
    ("bits", "dtype"), [(None, "float32"), (12, "uint16"), (16, "uint16"), (20, "uint32")]
)
def test_type_of_the_frames(bits: int | None, dtype: str) -> None:
    assert readout_type(Detector(1.0, offset_adu=100.0, bits=bits)) == dtype


def test_values_out_of_range_are_refused(ring: PixelRing) -> None:
    assert_each_refused(
        partial(Cycle, ring), frame_rate_hz=[0, np.nan], readout_fraction=[1.1], rows_per_block=[0, 25]
    )
    with refused("n_frames = 0"):
        Cycle(ring).run(0)


def test_a_ring_of_other_frames_is_refused(name: str) -> None:
    with PixelRing.create(name, (16, 16), np.float32) as other, refused("ring: expected frames of"):
        Cycle(other)
