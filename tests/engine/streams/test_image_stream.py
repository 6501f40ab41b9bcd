"""Streams of ImageStreamIO: read and written as the offsets of its header say, or refused."""

import os
import struct
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.engine.commands import needs_shared_memory, start
from tests.engine.image_files import IsioFile
from tests.patience import LIMIT_S, wait_for
from tests.refusals import refused

from faintspot.engine.frames.pixel_ring import PixelRing
from faintspot.engine.processes.segment import FOLDER
from faintspot.engine.streams.bridge import StreamBridge, StreamOut
from faintspot.engine.streams.image_layout import IncompatibleStreamError
from faintspot.engine.streams.image_stream import ImageStream, ImageStreamWriter
from faintspot.engine.streams.stream import Follower, open_stream

pyshmem = pytest.importorskip("pyshmem")
pytestmark = [needs_shared_memory, pytest.mark.slow]


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MILK_SHM_DIR", str(tmp_path))
    return tmp_path


def isio(folder: Path, sizes: tuple[int, ...] = (5, 3), dtype: str = "u2", **changes: Any) -> IsioFile:
    return IsioFile(folder / "cam.im.shm", sizes, dtype, **changes)


def values_of(stream: ImageStream) -> Any:
    publication = stream.read(None, 1.0)
    assert publication is not None
    return publication.values


@pytest.mark.parametrize("dtype", ["u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f2", "f4", "f8"])
def test_isio_is_read(folder: Path, dtype: str) -> None:
    file = isio(folder, dtype=dtype)
    stream = ImageStream("cam")
    assert (stream.shape, stream.dtype, stream.count, stream.same()) == ((3, 5), np.dtype(dtype), 0, True)
    sent = np.arange(15).reshape(3, 5)  # x is the first axis, and the last of NumPy's
    file.write(sent)
    publication = stream.read(None, 1.0)
    assert publication is not None
    assert (publication.number, publication.total) == (0, 1)
    np.testing.assert_array_equal(publication.values, sent)
    out = np.zeros((3, 5), np.float32)
    file.write(sent + 1)
    assert stream.read(out, 1.0) is not None
    np.testing.assert_array_equal(out, sent + 1)
    assert stream.number == 1
    stream.close()


def test_a_circular_buffer_gives_its_newest_slice(folder: Path) -> None:
    file = isio(folder, (5, 3, 4), "f4", imagetype=0x20001, buffered=2)
    stream = ImageStream("cam")
    assert stream.shape == (3, 5)
    for number in range(6):
        file.write(np.full((3, 5), number), slice_number=number % 4)
        assert np.all(values_of(stream) == number)
    file.put(272, "Q", 99)  # whatever it says, it stays within the buffer
    assert values_of(stream).shape == (3, 5)


@pytest.mark.parametrize("posts", [True, False])
def test_waiting_ends_with_a_post_or_the_counter(folder: Path, posts: bool) -> None:
    file = isio(folder)
    stream = ImageStream("cam")
    assert stream.wait(0, 0.01) is False
    timer = threading.Timer(0.05, lambda: file.write(np.ones((3, 5)), posts=posts))
    timer.daemon = True
    timer.start()
    assert stream.wait(0, LIMIT_S)
    assert stream.count == 1
    timer.join(LIMIT_S)


def test_a_semaphore_is_taken_and_given_back(folder: Path) -> None:
    file = isio(folder)
    file.put(file.readers, "i", os.getppid())  # somebody living has the first
    file.put(file.readers + 4, "i", 2**22 - 1)  # and somebody dead the second
    stream = ImageStream("cam")
    assert file.get(file.readers + 4, "i") == os.getpid()
    file.write(np.ones((3, 5)))
    assert stream.wait(0, 1.0)
    stream.close()
    assert file.get(file.readers, "i") == os.getppid()
    assert file.get(file.readers + 4, "i") == 0


def test_what_is_being_written_is_not_read(folder: Path) -> None:
    file = isio(folder)
    stream = ImageStream("cam")
    file.write(np.ones((3, 5)))
    file.put(288, "B", 1)
    assert stream.read(None, 0.02) is None
    file.put(288, "B", 0)
    assert stream.read(None, 0.02) is not None


def test_a_file_that_is_cut_or_replaced(folder: Path) -> None:
    file = isio(folder)
    stream = ImageStream("cam")
    file.path.unlink()
    assert stream.same() is None
    isio(folder)
    assert stream.same() is False
    other = ImageStream("cam")
    os.truncate(folder / "cam.im.shm", 10)
    assert other.same() is False
    assert other.read(None, 0.01) is None


@pytest.mark.parametrize(
    ("changes", "naming"),
    [
        ({"version": b"1.00"}, "has version '1.00', expected '2.00'"),
        ({"nelement": 16}, r"2 axes \[5, 3\] of 16 values"),
        ({"naxis": 4}, "4 axes"),
        ({"naxis": 0}, "0 axes"),
        ({"code": 11}, "values of type 11, expected real numbers"),
        ({"location": 0}, "memory of a GPU"),
        ({"code": 10}, "bytes, expected"),
    ],
)
def test_other_metadata_are_refused(folder: Path, changes: dict[str, Any], naming: str) -> None:
    isio(folder, **changes)
    with pytest.raises(IncompatibleStreamError, match=naming):
        open_stream("isio:cam")


def test_what_is_no_stream_is_refused(folder: Path) -> None:
    with pytest.raises(FileNotFoundError):
        open_stream("isio:cam")
    (folder / "text.im.shm").write_bytes(b"text")
    os.mkfifo(folder / "pipe.im.shm")
    (folder / "sub.im.shm").mkdir()
    (folder / "long.im.shm").write_bytes(isio(folder).memory[:] + b"more")
    for name, naming in (
        ("text", "is not a stream"),
        ("pipe", "is not a stream"),
        ("sub", "directory"),
        ("long", "it may have another version"),
    ):
        with pytest.raises(IncompatibleStreamError, match=naming):
            open_stream(f"isio:{name}")
    for bad in ("isio:a/b", "isio:", "isio:x y", f"isio:{'x' * 90}"):
        with refused(bad):
            Follower(bad)


def test_random_metadata_never_end_the_process(folder: Path) -> None:
    """Damaged headers are refused, or describe a file of exactly that size."""
    rng = np.random.default_rng(0)
    original = bytes(isio(folder).memory)
    for _ in range(500):
        content = bytearray(original)
        for place in rng.integers(100, 320, 4):
            content[place] = rng.integers(256)
        (folder / "bad.im.shm").write_bytes(content)
        try:
            stream = open_stream("isio:bad")
        except IncompatibleStreamError:
            continue
        stream.read(None, 0.0)
        stream.close()


def test_isio_is_written(folder: Path) -> None:
    writer = ImageStreamWriter("slopes", (6,))
    path = folder / "slopes.im.shm"
    assert [each.name for each in folder.iterdir()] == ["slopes.im.shm"]
    writer.publish(np.arange(6, dtype=np.float32), 41)
    writer.publish(np.arange(6, dtype=np.float32) + 1, 42)
    content = path.read_bytes()
    data = 384
    assert len(content) == data + 24 + 128 + 320 + 32 + 4 * 40 + 640
    assert content[:5] == b"2.00\0"
    assert content[32:39] == b"slopes\0"
    assert content[112] == 2
    assert struct.unpack_from("<3I", content, 116) == (6, 1, 0)
    assert struct.unpack_from("<Q", content, 128) == (6,)
    assert (content[136], content[224], struct.unpack_from("<b", content, 240)) == (9, 1, (-1,))
    assert struct.unpack_from("<Q", content, 144) == (2,)
    assert struct.unpack_from("<i", content, 216) == (os.getpid(),)
    assert struct.unpack_from("<Q", content, 232) == (path.stat().st_ino,)
    assert struct.unpack_from("<HH", content, 258) == (10, 10)
    assert struct.unpack_from("<QQ", content, 264) == (2, 0)
    assert (content[288], struct.unpack_from("<H", content, 290)) == (0, (1,))
    assert struct.unpack_from("<Q", content, 312) == (24,)
    np.testing.assert_array_equal(np.frombuffer(content, "f4", 6, data), np.arange(6) + 1)
    keyword = data + 24
    assert (content[keyword : keyword + 6], content[keyword + 16 : keyword + 17]) == (b"FRAME\0", b"L")
    assert struct.unpack_from("<qQ", content, keyword + 24) == (42, 0)
    assert struct.unpack_from("<Q", content, keyword + 40) == (2,)
    assert struct.unpack_from("<10i", content, keyword + 128 + 352) == (-1,) * 10
    seconds = struct.unpack_from("<q", content, 184)[0]
    assert abs(seconds - time.clock_gettime(time.CLOCK_TAI)) < 60
    reader = ImageStream("slopes")
    assert (reader.shape, reader.maker_lives()) == ((1, 6), True)
    assert reader.wait(2, 0.01) is False
    writer.publish(np.zeros(6, np.float32), 43)
    assert reader.wait(2, 1.0)
    for number in range(30):  # nobody waits, and nothing overflows
        writer.publish(np.zeros(6, np.float32), number)
    values = struct.iter_unpack("<I28x", path.read_bytes()[keyword + 128 : keyword + 128 + 320])
    assert [value for (value,) in values] == [10] * 10
    writer.close()
    assert list(folder.iterdir()) == []


def test_who_may_take_a_name(folder: Path) -> None:
    isio(folder, pid=os.getppid())
    with refused("cam.im.shm", f"{os.getppid()}"):
        ImageStreamWriter("cam", (6,))
    (folder / "cam.im.shm").unlink()
    isio(folder, pid=2**22 - 1)
    ImageStreamWriter("cam", (6,)).close()
    (folder / "cam.im.shm").write_text("something else")
    os.mkfifo(folder / "pipe.im.shm")
    (folder / "folder.im.shm").mkdir()
    for name in ("cam", "pipe", "folder"):
        with refused(f"{name}.im.shm"):
            ImageStreamWriter(name, (6,))


def test_counters_that_are_mad(folder: Path, name: str) -> None:
    lines: list[str] = []
    file = isio(folder)
    bridge = StreamBridge("isio:cam", name, say=lines.append, spins=False)
    wait_for(lambda: bridge.step() or bool(lines))
    for counter in (2**64 - 2, 3):  # written by somebody else, or going back
        file.put(264, "Q", counter)
        file.write(np.ones((3, 5), np.uint16))
        wait_for(bridge.step)
    assert (bridge.counters.taken, bridge.counters.not_ahead) == (2, 1)
    assert (bridge.counters.missed, bridge.counters.restarts) == (0, 1)  # the jump, not what lies between
    bridge.close()


def test_command_both_ways(folder: Path, name: str) -> None:
    file = isio(folder)
    slopes = pyshmem.create(f"{name}_slopes", shape=(8,), dtype=np.float32)
    arguments = ["isio:cam", "--to", "isio:cam_slopes", "--name", name, "--frames", "3"]
    process = start("from faintspot.cli.realtime.sources import bridge; bridge()", *arguments)
    try:
        wait_for(lambda: (FOLDER / name).exists() or process.poll() is not None)
        wait_for(lambda: (folder / "cam_slopes.im.shm").exists() or process.poll() is not None)
        reader = ImageStream("cam_slopes")
        slopes.write(np.arange(8, dtype=np.float32), frame_id=1)
        wait_for(lambda: reader.count == 1)
        ring = PixelRing.attach(name)
        for number in range(3):
            file.write(np.full((3, 5), number))
            # The whole frame: one that is written while this is copied would replace it.
            wait_for(lambda number=number: ring.progress() >= (number, 3) or ring.closed)
        out, errors = process.communicate(timeout=LIMIT_S)
    finally:
        process.kill()
        process.communicate()
        slopes.unlink()
    assert (process.returncode, errors) == (0, "")
    assert f"{name}: 3 frames, 0 missed" in out
    assert f"{name}: 1 times slopes, 0 missed" in out
    assert not (folder / "cam_slopes.im.shm").exists()
    with refused("slopes", "isio:NAME"):
        StreamOut(f"{name}_slopes", "slopes")
