"""What every format of frames must do."""

import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from tests.io.frame_files import FRAME_FILES, FrameFile, cube
from tests.refusals import refused

from faintspot.base.errors import InputError, MissingExtraError
from faintspot.io import open_frames


@pytest.fixture(params=FRAME_FILES)
def kind(request: pytest.FixtureRequest) -> FrameFile:
    return FRAME_FILES[request.param]


@pytest.fixture
def path(tmp_path: Path, kind: FrameFile) -> Path:
    return tmp_path / f"a.{kind.ending}"


@pytest.mark.parametrize("dtype", ["int16", "float32", "uint8"])
def test_blocks_are_the_frames(path: Path, kind: FrameFile, dtype: str) -> None:
    frames = cube(dtype=dtype)
    kind.save(path, frames)
    with open_frames([path]) as source:
        assert (source.n_frames, source.shape, source.dtype) == (11, (6, 8), frames.dtype)
        for start, stop in [(0, 4), (4, 5), (8, 11), (2, 7), (0, 11)]:  # forward, back and the whole
            block = source.block(start, stop)
            assert (block.dtype, block.dtype.isnative) == (frames.dtype, True)
            np.testing.assert_array_equal(block, frames[start:stop])
            block[:] = 0  # it belongs to the caller
        assert [start for start, _ in source.blocks(2, 11, 4)] == [2, 6, 10]


def test_two_dimensions_are_one_frame(path: Path, kind: FrameFile) -> None:
    kind.save(path, cube()[0])
    with open_frames([path]) as source:
        assert source.n_frames == 1
        np.testing.assert_array_equal(source.block(0, 1), cube()[:1])


def test_key_selects_the_frames(path: Path, kind: FrameFile) -> None:
    kind.save(path, cube())
    with refused(path.name):
        open_frames([path], key="nothing")
    if kind.key:
        for source in (open_frames([f"{path}:{kind.key}"]), open_frames([path], key=kind.key)):
            with source:
                np.testing.assert_array_equal(source.block(2, 9), cube()[2:9])


@pytest.mark.slow
def test_memory_is_bounded(path: Path, kind: FrameFile) -> None:
    """While blocks of 10 frames of 0.33 MB are read, of 6.6 MB."""
    if kind.whole:
        return
    frames = np.zeros((200, 128, 128), np.int16)
    frames[:, 5, 6] = np.arange(200)
    kind.save(path, frames)
    with open_frames([path]) as source:
        source.block(0, 10)  # imports and codecs
        tracemalloc.start()
        try:
            for start, block in source.blocks(0, 200, 10):
                assert np.array_equal(block, frames[start : start + 10])
            assert tracemalloc.get_traced_memory()[1] < 5_000_000
        finally:
            tracemalloc.stop()
        np.testing.assert_array_equal(source.block(150, 160), frames[150:160])


def test_missing_package(path: Path, kind: FrameFile, monkeypatch: pytest.MonkeyPatch) -> None:
    if not kind.package:
        return
    kind.save(path, cube())
    monkeypatch.setitem(sys.modules, kind.package, None)
    with pytest.raises(MissingExtraError, match=rf"{kind.package.split('.')[0]}.*faintspot\[io\]"):
        open_frames([path])


def test_damage_is_one_line_or_harmless(path: Path, kind: FrameFile) -> None:
    """Cut short or with wrong bytes, mostly in the header: frames or InputError, nothing else."""
    kind.save(path, cube())
    files = [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file())
    rng = np.random.default_rng(1)
    messages = []
    for attempt in range(24):
        file = files[attempt % len(files)]
        content = file.read_bytes()
        damaged = bytearray(content)
        if attempt % 3 == 0:
            damaged = damaged[: rng.integers(len(damaged))]
        else:
            for position in rng.integers(min(len(damaged), 400 * (attempt % 3)), size=3):
                damaged[position] = rng.integers(256)
        file.write_bytes(damaged)
        messages += read_or_refused(path)
        file.write_bytes(content)
    assert messages
    assert all("\n" not in message and path.name in message for message in messages)


def test_cut_anywhere(path: Path, kind: FrameFile) -> None:
    """Refused in one line, or all frames are there: the end of a file may be text."""
    kind.save(path, cube())
    if path.is_dir():
        return
    content = path.read_bytes()
    lengths = range(9, len(content), max(1, len(content) // 20))
    messages = []
    for length in lengths:
        path.write_bytes(content[:length])
        messages += read_or_refused(path, all_frames=True)
    assert len(messages) > len(lengths) / 3
    assert all("\n" not in message and path.name in message for message in messages)


def test_wrong_bit_in_the_frames(path: Path, kind: FrameFile) -> None:
    """A checksum finds it, at the latest when the last frame is read."""
    if not kind.checksum:
        return
    kind.save(path, cube(11, 60, 80))
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    for start in (0, 7):  # all, or the last frames alone
        with refused(path.name, "damaged"), open_frames([path]) as source:
            for _ in source.blocks(start, 11, 1):
                pass


def read_or_refused(path: Path, all_frames: bool = False) -> list[str]:
    """Read all frames, which must be those of `cube` if `all_frames`; return the message of a refusal."""
    try:
        with open_frames([path]) as source:
            frames = source.block(0, min(source.n_frames, 11))
    except InputError as error:
        return [str(error)]
    if all_frames:
        np.testing.assert_array_equal(frames, cube())
    return []
