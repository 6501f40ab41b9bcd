import importlib.util
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import DTypeLike
from PIL import Image
from tests.io.frame_files import cube, tifffile

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
    np.testing.assert_array_equal(read_array(f"{tmp_path / 'a.tif'}:1"), cube(1, 3, 4)[0])
    np.testing.assert_array_equal(read_array(f"{tmp_path / 'a.tif'}:0"), cube())


@pytest.mark.parametrize("compression", ["tiff_lzw", "packbits"])
@pytest.mark.parametrize("kind", ["u1", "u2", "i4", "f4"])
def test_tiff_that_pillow_decodes(
    tmp_path: Path, compression: str, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == "imagecodecs" else find_spec(name)
    )
    frames = cube().astype(kind)
    first, *others = (Image.fromarray(frame) for frame in frames)
    first.save(tmp_path / "a.tif", compression=compression, save_all=True, append_images=others)
    with open_frames([tmp_path / "a.tif"]) as source:
        assert source.dtype == kind
        np.testing.assert_array_equal(source.block(0, 11), frames)
        np.testing.assert_array_equal(source.block(7, 8), frames[7:8])
