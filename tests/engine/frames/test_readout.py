"""A read-out publishes its frames in order, row by row, at its rate; those of files, too."""

import gzip
import signal
import threading
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from numpy.typing import NDArray
from tests.engine.commands import needs_shared_memory
from tests.refusals import assert_each_refused, refused

from faintspot.cli.realtime import sources as realtime_sources
from faintspot.cli.realtime.sources import replay
from faintspot.engine.frames import readout
from faintspot.engine.frames import readout as replay_module
from faintspot.engine.frames.pixel_ring import PixelRing
from faintspot.engine.frames.readout import Readout, Replay, readout_type, ring_type
from faintspot.engine.processes.segment import FOLDER
from faintspot.io import open_frames
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
    source, stop = Cycle(ring), threading.Event()
    reader = PixelRing.attach(ring.name)
    stop.set()  # before the first one
    report = source.run(None, stop)
    assert (report.frames, report.overruns, report.frame_rate_hz) == (0, 0, 0.0)
    assert ring.progress() == (-1, 0)
    for number in range(12):
        assert source.run(1).frames == 1
        assert reader.progress() == (number, SHAPE[0])
        np.testing.assert_array_equal(reader.slot(number), source.frames[number % 5])
    assert source.run(7).frames == 7  # the slots hold the last eight
    for number in range(11, 19):
        assert reader.intact(number)
        np.testing.assert_array_equal(reader.slot(number), source.frames[number % 5])


@pytest.mark.parametrize("rows_per_block", [5, 24])
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


def test_values_out_of_range_are_refused(ring: PixelRing) -> None:
    assert_each_refused(
        partial(Cycle, ring), frame_rate_hz=[0, np.nan], readout_fraction=[1.1], rows_per_block=[0, 25]
    )
    with refused("n_frames = 0"):
        Cycle(ring).run(0)
    with PixelRing.create(f"{ring.name}_2", (16, 16), np.float32) as other, refused("expected frames of"):
        Cycle(other)
    types = [readout_type(Detector(1.0, offset_adu=100.0, bits=bits)) for bits in (None, 12, 16, 20)]
    assert types == ["float32", "uint16", "uint16", "uint32"]


FILES = (6, 5)


def cube(n: int, dtype: str = "uint16") -> np.ndarray:
    return np.random.default_rng(n).integers(0, 250, (n, *FILES)).astype(dtype)


def stored(folder: Path, frames: np.ndarray) -> Path:
    path = folder / "frames.npy"
    np.save(path, frames)
    return path


def played(name: str, path: Path, *, slots: int = 64, n_frames: int | None = None, **options: Any) -> Any:
    """Play files at speed; the report, and what lies in the ring afterwards, by number."""
    with (
        open_frames([path]) as source,
        PixelRing.create(name, source.shape, ring_type(source.dtype), slots=slots) as ring,
        Replay(source, ring, frame_rate_hz=5e3, **options) as player,
    ):
        report = player.run(n_frames)
        newest = ring.progress()[0]
        numbers = range(max(0, newest - slots + 1), newest + 1)
        return report, {number: ring.slot(number).copy() for number in numbers if ring.intact(number)}


@pytest.mark.parametrize(
    ("dtype", "block_bytes"), [("uint16", 1), ("float64", 10_000_000), (">i2", 10_000_000)]
)
def test_frames_are_those_of_the_file(
    name: str, tmp_path: Path, dtype: str, block_bytes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(replay_module, "_BLOCK_BYTES", block_bytes)
    frames = cube(20, dtype)
    if dtype == "float64":
        frames[0, 1, 2], frames[1, 0, 0] = np.nan, 1e300  # more than float32 can hold
    report, seen = played(name, stored(tmp_path, frames))
    assert report.frames == 20
    assert list(seen) == list(range(20))
    for number, frame in seen.items():
        assert frame.dtype == (np.uint16 if dtype == "uint16" else np.float32)
        with np.errstate(over="ignore"):
            np.testing.assert_array_equal(frame, frames[number].astype(frame.dtype))


def test_a_part_of_it_repeatedly(name: str, tmp_path: Path) -> None:
    frames = cube(20)
    _, seen = played(name, stored(tmp_path, frames), first=5)
    assert list(seen) == list(range(5, 20))
    with (
        open_frames([stored(tmp_path, frames)]) as source,
        PixelRing.create(name, FILES, np.uint16, slots=64) as ring,
        Replay(source, ring, frame_rate_hz=5e3, first=5, n_frames=4, repeat=True) as player,
    ):
        assert player.n_frames is None
        assert player.run(10).frames == 10
        assert player.run(1).frames == 1
        for number in range(5, 16):
            np.testing.assert_array_equal(ring.slot(number), frames[5 + (number - 5) % 4])


class SlowEngine:
    """Measures one frame each time that the replay has nothing to do but wait."""

    def __init__(self, name: str, most: int = 99) -> None:
        self.name, self.most = name, most
        self.ring: PixelRing | None = None
        self.seen: list[np.ndarray] = []

    def measure(self) -> None:
        if self.ring is None:
            self.ring = PixelRing.attach(self.name, follows=True)
            self.ring.follow(0)
        arrival = len(self.seen) + 1
        number = self.ring.number_of(arrival)
        if len(self.seen) == self.most:
            self.ring.unfollow()
        elif number >= 0:
            self.seen.append(self.ring.slot(number).copy())
            self.ring.follow(arrival)


@pytest.mark.parametrize(("most", "published"), [(99, [20]), (8, range(8, 20))])
def test_waits_for_a_slow_engine_and_ends_with_it(
    name: str, tmp_path: Path, most: int, published: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    frames, engine = cube(20), SlowEngine(name, most)
    monkeypatch.setattr(replay_module, "_nap", engine.measure)
    report, _ = played(name, stored(tmp_path, frames), slots=3, waits=True)
    assert report.frames in published
    np.testing.assert_array_equal(engine.seen, frames[:most])


def test_a_damaged_file(name: str, tmp_path: Path) -> None:
    """What comes before the damage is played; then one line says which frame is lost."""
    frames, path = cube(500), tmp_path / "frames.fits.gz"
    fits = pytest.importorskip("astropy.io.fits")
    fits.writeto(tmp_path / "frames.fits", frames.astype(np.int16))
    whole = gzip.compress((tmp_path / "frames.fits").read_bytes())
    path.write_bytes(whole[: len(whole) * 3 // 4])
    with refused(path.name):
        played(name, path, rows_per_block=None)
    assert not (FOLDER / name).exists()


def test_replay_refuses_wrong_options(name: str, tmp_path: Path) -> None:
    with (
        open_frames([stored(tmp_path, cube(4))]) as source,
        PixelRing.create(name, FILES, np.uint16) as ring,
    ):
        good = partial(Replay, source, ring, frame_rate_hz=100.0)
        assert_each_refused(good, first=[-1, 4], n_frames=[0, 5], frame_rate_hz=[0.0], rows_per_block=[7])
        with refused("n_frames = 3"):
            good(first=2, n_frames=3)
    with refused("real numbers"):
        ring_type(np.dtype(complex))


# ---- the command


@pytest.fixture
def no_head_start(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(realtime_sources, "_HEAD_START_S", 0.0)


@pytest.mark.usefixtures("no_head_start")
def test_command_replays_the_frames_asked_for(name: str, tmp_path: Path) -> None:
    path = stored(tmp_path, cube(30))
    options = [str(path), "--name", name, "--frame-rate-hz", "2000", "--first", "5", "--frames", "20"]
    result = CliRunner().invoke(replay, options)
    assert result.exit_code == 0, result.output
    first, last = result.stdout.splitlines()
    assert {name + ":", "6", "5", "20", "2000"} <= set(first.split())
    assert last.startswith(f"{name}: 20 ")
    assert not (FOLDER / name).exists()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_replay_waits_for_a_slow_engine(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    frames, engine = cube(10), SlowEngine(name)
    monkeypatch.setattr(replay_module, "_nap", engine.measure)
    result = CliRunner().invoke(replay, [str(stored(tmp_path, frames)), "--name", name])
    assert result.exit_code == 0, result.output
    np.testing.assert_array_equal(engine.seen, frames)
