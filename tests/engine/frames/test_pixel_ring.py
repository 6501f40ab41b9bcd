"""The pixel ring: between processes, nothing is torn, lost or mixed unseen; what is not a ring is refused."""

from __future__ import annotations

import multiprocessing
import os
import stat
import threading
import time
from multiprocessing.queues import Queue
from multiprocessing.synchronize import Barrier

import numpy as np
import pytest
from tests.engine.commands import is_stale, needs_shared_memory, process, start
from tests.patience import LIMIT_S, wait_for
from tests.refusals import refused

from faintspot.base.errors import InputError
from faintspot.engine.frames.pixel_ring import ARRIVALS, FRAME, ROWS, PixelRing
from faintspot.engine.processes.segment import CLOSED, FOLDER

pytestmark = [needs_shared_memory, pytest.mark.slow]

SHAPE = (24, 32)
ROW_NUMBERS = np.arange(SHAPE[0])[:, None]


def content(frame: int) -> np.ndarray:
    """What the tests' writer writes: frame * 1000 + row in each pixel."""
    return np.broadcast_to(frame * 1000 + ROW_NUMBERS, SHAPE)


def write(name: str, n_frames: int, meeting: Barrier) -> None:
    """Write frames by blocks of rows, from when all readers are there until all have finished."""
    with PixelRing.create(name, SHAPE, np.int32, slots=4) as ring:
        meeting.wait(LIMIT_S)
        for number in range(n_frames):
            slot, values = ring.begin(), content(number)
            for first in range(0, SHAPE[0], 3):
                slot[first : first + 3] = values[first : first + 3]
                ring.rows_ready(first + 3)
            ring.end()
        meeting.wait(LIMIT_S)


def read(name: str, last: int, answers: Queue[tuple[int, int, int]], meeting: Barrier) -> None:
    """Look at whatever is there until the last frame; count looks, lapses and wrong rows."""
    ring = attached(name)
    meeting.wait(LIMIT_S)
    looks = lapped = wrong = 0
    frame, rows = -1, 0
    while (frame, rows) != (last, SHAPE[0]):
        frame, rows = ring.progress()
        if frame < 0:
            continue
        seen = ring.slot(frame)[:rows].copy()
        if ring.intact(frame):
            wrong += not np.array_equal(seen, content(frame)[:rows])
            looks += 1
        else:
            lapped += 1
    answers.put((looks, lapped, wrong))
    meeting.wait(LIMIT_S)


def attached(name: str) -> PixelRing:
    """Attach as soon as the ring is there."""
    end = time.monotonic() + LIMIT_S
    while time.monotonic() < end:
        try:
            return PixelRing.attach(name)
        except InputError:
            time.sleep(0.005)
    raise TimeoutError(name)


def test_rows_that_progress_names_are_there_for_two_readers(name: str) -> None:
    spawn, n_frames = multiprocessing.get_context("spawn"), 10_000
    answers: Queue[tuple[int, int, int]] = spawn.Queue()
    meeting = spawn.Barrier(3)
    reading = (name, n_frames - 1, answers, meeting)
    with (
        process(read, *reading) as first,
        process(read, *reading) as second,
        process(write, name, n_frames, meeting) as writer,
    ):
        results = [answers.get(timeout=LIMIT_S) for _ in range(2)]
        for each in (first, second, writer):
            each.join(LIMIT_S)
            assert each.exitcode == 0
    answers.close()
    answers.join_thread()
    for looks, _, wrong in results:
        assert looks > 20
        assert wrong == 0
    assert not (FOLDER / name).exists()


def test_rows_frames_and_laps(name: str) -> None:
    with PixelRing.create(name, SHAPE, np.uint16, slots=3) as ring, PixelRing.attach(name) as reader:
        assert (reader.name, reader.shape, reader.dtype.str, reader.slots) == (name, SHAPE, "<u2", 3)
        assert reader.creator_pid == os.getpid()
        assert reader.identity == ring.identity
        assert reader.progress() == (-1, 0)
        assert not reader.intact(0)
        slot = ring.begin()
        assert reader.progress() == (0, 0)
        slot[:5] = 7
        ring.rows_ready(5)
        assert reader.progress() == (0, 5)
        assert (int(reader.cells[FRAME, 0]), int(reader.cells[ROWS, 0])) == (0, 5)
        assert reader.last_row_time_ns(0) == 0
        ring.end()
        assert reader.last_row_time_ns(0) > 0
        moment = reader.last_row_time_ns(0)
        ring.end()  # again: changes nothing
        assert reader.last_row_time_ns(0) == moment
        for number in (1, 2):
            ring.publish(np.full(SHAPE, number))
            assert reader.intact(0)
        np.testing.assert_array_equal(reader.slot(0)[:5], 7)
        ring.begin()
        assert not reader.intact(0)
        assert reader.last_row_time_ns(0) == 0
        assert not reader.pixels.flags.writeable
        assert not reader.cells.flags.writeable


def test_repeats_skips_and_short_frames_are_seen(name: str) -> None:
    with PixelRing.create(name, SHAPE, np.float32) as ring, PixelRing.attach(name) as reader:
        ring.publish(np.full(SHAPE, 1.0), 5)
        assert reader.intact(5, 1)
        ring.publish(np.full(SHAPE, 2.0), 5)
        assert reader.intact(5)
        assert not reader.intact(5, 1)
        assert reader.arrivals == 2
        ring.publish(np.full(SHAPE, 3.0), 50)
        assert reader.progress() == (50, SHAPE[0])
        assert not reader.intact(49)
        ring.begin(51)
        ring.rows_ready(4)
        ring.begin(52)  # 51 was cut short
        assert reader.last_row_time_ns(51) == 0
        assert reader.progress() == (52, 0)
        ring.publish(np.zeros(SHAPE), 3)  # the camera counts anew
        assert reader.progress() == (3, SHAPE[0])


def test_progress_does_not_mix_two_frames(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A frame that begins between the looks at number and rows: it looks again."""

    looks = iter([(ARRIVALS, 1), (FRAME, 5), (ROWS, 9), (FRAME, 6), (ARRIVALS, 2), (FRAME, 6)])

    def look(row: int) -> int:
        expected, value = next(looks, (row, {ARRIVALS: 2, FRAME: 6, ROWS: 3}[row]))
        assert row == expected
        return value

    with PixelRing.create(name, SHAPE, np.float32) as ring, monkeypatch.context() as patch:
        patch.setattr(ring, "_look", look)
        assert ring.progress() == (6, 3)


def test_wrong_use_by_the_writer(name: str) -> None:
    with PixelRing.create(name, SHAPE, np.float32) as ring:
        with refused("rows = 1"):
            ring.rows_ready(1)
        ring.begin()
        ring.rows_ready(8)
        for rows in (7, SHAPE[0] + 1):
            with refused(f"rows = {rows}", "8 to 24"):
                ring.rows_ready(rows)
        reader = PixelRing.attach(name)
        with refused("pixel ring", "creator"):
            reader.begin()
    with refused("pixel ring", "creator"):
        ring.begin()


def test_closing_tells_readers_and_keeps_their_memory(name: str) -> None:
    ring = PixelRing.create(name, SHAPE, np.float32)
    reader = PixelRing.attach(name)
    assert stat.S_IMODE((FOLDER / name).stat().st_mode) == 0o600
    assert [path for path in FOLDER.iterdir() if name in path.name] == [FOLDER / name]
    assert not is_stale(reader)
    ring.publish(np.full(SHAPE, 3.0))
    view = reader.slot(0)
    reader.close()
    assert not ring.closed
    assert (FOLDER / name).exists()
    ring.close()
    ring.close()
    assert reader.cells[CLOSED, 0] == 1
    assert is_stale(reader)
    np.testing.assert_array_equal(view, 3.0)  # memory in use stays
    assert not (FOLDER / name).exists()
    # A writer of the same name that came later keeps its ring when the first one closes once more.
    with PixelRing.create(name, SHAPE, np.float32) as second:
        second.publish(np.ones(SHAPE))
        ring.close()
        assert (FOLDER / name).exists()
        assert is_stale(reader)
        assert reader.progress() == (0, SHAPE[0])


def test_the_ring_of_a_killed_writer_is_replaced(name: str) -> None:
    """Of many that do so one wins. It may be cut; a living one is not replaced."""
    code = (
        "import time, numpy as np\n"
        "from faintspot.engine.frames.pixel_ring import PixelRing\n"
        f"ring = PixelRing.create({name!r}, {SHAPE}, np.float32)\n"
        f"ring.publish(np.full({SHAPE}, 9.0))\n"
        "time.sleep(100)\n"
    )
    with start(code) as writer:
        reader = attached(name)
        wait_for(lambda: reader.last_row_time_ns(0) > 0)
        with refused(f"process {writer.pid}"):
            PixelRing.create(name, (8, 8), np.uint16)
        assert not is_stale(reader)
        writer.kill()
        wait_for(lambda: is_stale(reader))  # a zombie: nobody has asked for what is left of it
        assert not reader.closed
    left = (FOLDER / name).read_bytes()
    made: list[PixelRing] = []
    said: list[str] = []

    def create() -> None:
        try:
            made.append(PixelRing.create(name, (8, 8), np.uint16))
        except InputError as error:
            said.append(str(error))

    threads = [threading.Thread(target=create) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (len(made), len(said)) == (1, 7)
    again = PixelRing.attach(name)
    assert again.identity == made[0].identity != reader.identity
    assert again.shape == (8, 8)
    assert not is_stale(again)
    assert is_stale(reader)
    np.testing.assert_array_equal(reader.slot(0), 9.0)  # the old memory stays as it was
    made[0].close()
    (FOLDER / name).write_bytes(left[:8192])
    (FOLDER / name).chmod(0o600)
    with refused("8192"):
        PixelRing.attach(name)
    with PixelRing.create(name, SHAPE, np.float32):
        assert not is_stale(PixelRing.attach(name))
