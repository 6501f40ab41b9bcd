"""Recorded frames as a source: the frames of the files, in order, at the rate, and an end in order."""

import gzip
import signal
import sys
import threading
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from tests.engine.commands import needs_shared_memory
from tests.refusals import assert_each_refused, refused

from faintspot.cli.realtime import sources as realtime_sources
from faintspot.cli.realtime.sources import replay
from faintspot.engine.frames import readout as replay_module
from faintspot.engine.frames.pixel_ring import PixelRing
from faintspot.engine.frames.readout import Replay, ring_type
from faintspot.engine.processes.child_processes import quick_switching
from faintspot.engine.processes.segment import FOLDER
from faintspot.io import FrameSource, open_frames

pytestmark = [needs_shared_memory, pytest.mark.slow]
SHAPE = (6, 5)


def cube(n: int, dtype: str = "uint16") -> np.ndarray:
    return np.random.default_rng(n).integers(0, 250, (n, *SHAPE)).astype(dtype)


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


@pytest.mark.parametrize("dtype", ["uint16", "int32", "float64", ">i2"])
@pytest.mark.parametrize("block_bytes", [1, 10_000_000])
def test_frames_are_those_of_the_file(
    name: str, tmp_path: Path, dtype: str, block_bytes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(replay_module, "_BLOCK_BYTES", block_bytes)
    frames = cube(20, dtype)
    report, seen = played(name, stored(tmp_path, frames))
    assert report.frames == 20
    assert list(seen) == list(range(20))
    for number, frame in seen.items():
        assert frame.dtype == (np.uint16 if dtype == "uint16" else np.float32)
        np.testing.assert_array_equal(frame, frames[number])


def test_a_part_of_it_repeatedly(name: str, tmp_path: Path) -> None:
    frames = cube(20)
    report, seen = played(name, stored(tmp_path, frames), first=5, n_frames=None, repeat=False)
    assert report.frames == 15
    assert list(seen) == list(range(5, 20))
    with (
        open_frames([stored(tmp_path, frames)]) as source,
        PixelRing.create(name, SHAPE, np.uint16, slots=64) as ring,
        Replay(source, ring, frame_rate_hz=5e3, first=5, n_frames=4, repeat=True) as player,
    ):
        assert player.n_frames is None
        assert player.run(10).frames == 10
        assert player.run(1).frames == 1
        for number in range(5, 16):
            np.testing.assert_array_equal(ring.slot(number), frames[5 + (number - 5) % 4])


def test_nan_and_what_float32_cannot_hold(name: str, tmp_path: Path) -> None:
    frames = cube(2, "float64")
    frames[0, 1, 2], frames[1, 0, 0] = np.nan, 1e300
    _, seen = played(name, stored(tmp_path, frames))
    assert np.isnan(seen[0][1, 2])
    assert np.isinf(seen[1][0, 0])


def test_rows_in_blocks(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    said, seen = PixelRing.rows_ready, []

    def watched(self: PixelRing, rows: int) -> None:
        said(self, rows)
        seen.append(self.progress())

    monkeypatch.setattr(PixelRing, "rows_ready", watched)
    played(name, stored(tmp_path, cube(2)), rows_per_block=4)
    assert seen == [(0, 4), (0, 6), (1, 4), (1, 6)]
    seen.clear()
    played(name, stored(tmp_path, cube(2)))
    assert seen == [(0, 6), (1, 6)]


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
    frames, path = cube(2000), tmp_path / "frames.fits.gz"
    fits = pytest.importorskip("astropy.io.fits")
    fits.writeto(tmp_path / "frames.fits", frames.astype(np.int16))
    whole = gzip.compress((tmp_path / "frames.fits").read_bytes())
    path.write_bytes(whole[: len(whole) * 3 // 4])
    with refused(match=path.name):
        played(name, path, rows_per_block=None)
    assert not (FOLDER / name).exists()


def test_stop_while_the_disk_is_slow(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stop, released = threading.Event(), threading.Event()
    read = FrameSource.block

    def slow(self: Any, start: int, end: int) -> Any:
        released.wait(30.0)
        return read(self, start, end)

    monkeypatch.setattr(FrameSource, "block", slow)
    with open_frames([stored(tmp_path, cube(4))]) as source, PixelRing.create(name, SHAPE, np.uint16) as ring:
        player = Replay(source, ring, frame_rate_hz=100.0)
        with player:
            threading.Timer(0.1, stop.set).start()
            assert player.run(None, stop).frames == 0
            released.set()


def test_replay_refuses_wrong_options(name: str, tmp_path: Path) -> None:
    with open_frames([stored(tmp_path, cube(4))]) as source, PixelRing.create(name, SHAPE, np.uint16) as ring:
        good = partial(Replay, source, ring, frame_rate_hz=100.0)
        assert_each_refused(good, first=[-1, 4], n_frames=[0, 5], frame_rate_hz=[0.0], rows_per_block=[7])
        with refused("n_frames = 3"):
            good(first=2, n_frames=3)
    with refused("real numbers"):
        ring_type(np.dtype(complex))


def test_switching_is_put_back() -> None:
    before = sys.getswitchinterval()
    with quick_switching():
        assert sys.getswitchinterval() < before
    assert sys.getswitchinterval() == before


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
