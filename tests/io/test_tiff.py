from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import DTypeLike
from tests.io.frame_files import assert_message, cube, save, tifffile

from faintspot.base.errors import InputError
from faintspot.io import open_frames, read_array


@pytest.mark.parametrize("dtype", ["<u2", ">u2", "<f4", ">f4", "u1"])
@pytest.mark.parametrize("big", [False, True])
def test_byte_orders_and_bigtiff(tmp_path: Path, dtype: DTypeLike, big: bool) -> None:
    frames = cube().astype(dtype)
    order = ">" if str(dtype).startswith(">") else "<"
    tifffile.imwrite(tmp_path / "a.tif", frames, byteorder=order, bigtiff=big, photometric="minisblack")
    with open_frames([tmp_path / "a.tif"]) as source:
        assert source.dtype.isnative
        np.testing.assert_array_equal(source.block(0, 11), frames)


def test_pages_written_one_after_another(tmp_path: Path) -> None:
    """Each is a series of its own to tifffile."""
    frames = cube()
    for frame in frames:
        tifffile.imwrite(tmp_path / "a.tif", frame, append=True)
    with open_frames([tmp_path / "a.tif"]) as source:
        np.testing.assert_array_equal(source.block(3, 9), frames[3:9])


def test_pages_of_several_sizes(tmp_path: Path) -> None:
    with tifffile.TiffWriter(tmp_path / "a.tif") as writer:
        writer.write(cube(), photometric="minisblack")
        writer.write(cube(1, 3, 4)[0])
    with pytest.raises(InputError) as error:
        open_frames([tmp_path / "a.tif"])
    assert_message(error, "pages of one size", "0: 11 x 6 x 8 int16, 1: 3 x 4 int16", "a.tif:NUMBER")
    np.testing.assert_array_equal(read_array(f"{tmp_path / 'a.tif'}:1"), cube(1, 3, 4)[0])
    np.testing.assert_array_equal(read_array(f"{tmp_path / 'a.tif'}:0"), cube())
    for key in ("2", "frames"):
        with pytest.raises(InputError) as error:
            open_frames([tmp_path / "a.tif"], key=key)
        assert_message(error, f"no pages {key!r}", "0: 11 x 6 x 8")


def test_colour(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "a.tif", np.zeros((6, 8, 3), np.uint8), photometric="rgb")
    with pytest.raises(InputError) as error:
        open_frames([tmp_path / "a.tif"])
    assert_message(error, "a.tif: expected grey frames", "(6, 8, 3)")


@pytest.mark.parametrize("name", ["stack.tif", "pages.tif", "deflated.tif"])
def test_cut_anywhere(tmp_path: Path, name: str) -> None:
    """One line says so, or all frames are there: the end of a stack may be text."""
    frames = cube()
    content = save(tmp_path / name, frames).read_bytes()
    refused = []
    for length in range(5, len(content), 61):
        (tmp_path / name).write_bytes(content[:length])
        try:
            with open_frames([tmp_path / name]) as source:
                np.testing.assert_array_equal(source.block(0, source.n_frames), frames)
        except InputError as error:
            refused.append(str(error))
    assert len(refused) > 10
    assert all(name in message and "\n" not in message for message in refused)


def test_damaged_page(tmp_path: Path) -> None:
    path = save(tmp_path / "deflated.tif", cube())
    with tifffile.TiffFile(path) as file:
        place = file.pages[4].dataoffsets[0]
    content = bytearray(path.read_bytes())
    content[place : place + 20] = bytes(20)
    path.write_bytes(content)
    with open_frames([path]) as source:
        np.testing.assert_array_equal(source.block(0, 4), cube()[:4])
        with pytest.raises(InputError) as error:
            source.block(0, 11)
    assert_message(error, "deflated.tif: frame 4 (counted from 0) cannot be read")


@pytest.mark.parametrize("bigtiff", [False, True])
@pytest.mark.parametrize("byteorder", ["<", ">"])
def test_pages_in_a_circle_are_refused(tmp_path: Path, bigtiff: bool, byteorder: Any) -> None:
    """The last page says that the first is next."""
    path = tmp_path / "a.tif"
    with tifffile.TiffWriter(path, bigtiff=bigtiff, byteorder=byteorder) as writer:
        for page in cube(3, dtype="uint16"):
            writer.write(page, contiguous=False, metadata=None)
    with open_frames([path]) as source:
        assert source.n_frames == 3
    with tifffile.TiffFile(path) as file:
        first, last = file.pages[0].offset, file.pages[2].offset
        tags = len(file.pages[2].tags)
    count_bytes, tag_bytes, size = (8, 20, 8) if bigtiff else (2, 12, 4)
    place = last + count_bytes + tags * tag_bytes
    content = bytearray(path.read_bytes())
    content[place : place + size] = first.to_bytes(size, "little" if byteorder == "<" else "big")
    path.write_bytes(content)
    with pytest.raises(InputError, match="in a circle"):
        open_frames([path])
