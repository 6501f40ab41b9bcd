"""TIFF, PNG, BMP and JPEG files: tests beyond those of every format."""

import importlib.util
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tests.io.frame_files import assert_frames, cube, tifffile
from tests.refusals import refused

from faintspot.io import open_frames


def test_byte_orders_and_bigtiff(tmp_path: Path) -> None:
    for dtype, big in product(["<u2", ">u2", "<f4", ">f4", "u1"], [False, True]):
        frames = cube().astype(dtype)
        order = ">" if dtype.startswith(">") else "<"
        tifffile.imwrite(tmp_path / "a.tif", frames, byteorder=order, bigtiff=big, photometric="minisblack")
        assert_frames(tmp_path / "a.tif", frames)


def test_pages_written_one_after_another(tmp_path: Path) -> None:
    """Each is a series of its own to tifffile."""
    for frame in cube():
        tifffile.imwrite(tmp_path / "a.tif", frame, append=True)
    assert_frames(tmp_path / "a.tif", cube())


def test_pages_of_several_sizes(tmp_path: Path) -> None:
    with tifffile.TiffWriter(tmp_path / "a.tif") as writer:
        writer.write(cube(), photometric="minisblack")
        writer.write(cube(1, 3, 4)[0])
    assert_frames(f"{tmp_path / 'a.tif'}:0", cube())
    assert_frames(f"{tmp_path / 'a.tif'}:1", cube(1, 3, 4))


def test_tiff_that_pillow_decodes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: (name != "imagecodecs" and find(name)) or None
    )
    for compression, kind in product(["tiff_lzw", "packbits"], ["u1", "u2", "i4", "f4"]):
        frames = cube().astype(kind)
        first, *others = (Image.fromarray(frame) for frame in frames)
        first.save(tmp_path / "a.tif", compression=compression, save_all=True, append_images=others)
        assert_frames(tmp_path / "a.tif", frames)


def test_grey_png_files_are_frames(tmp_path: Path) -> None:
    for kind in ("u1", "u2"):
        Image.fromarray(cube(1).astype(kind)[0]).save(tmp_path / "a.png")
        assert_frames(tmp_path / "a.png", cube(1).astype(kind))


@pytest.mark.parametrize("ending", ["png", "bmp", "jpg", "tif"])
def test_grey_in_any_mode(tmp_path: Path, ending: str) -> None:
    path, frame = tmp_path / f"a.{ending}", np.full((16, 24), 7, np.uint8)
    frame[8:, 8:16] = 200  # whole blocks, which JPEG keeps
    for mode in ("L", "RGB", *(["RGBA"] if ending != "jpg" else [])):
        Image.fromarray(frame).convert(mode).save(path)
        with open_frames([path]) as source:
            assert (source.n_frames, source.dtype) == (1, np.dtype(np.uint8))
            np.testing.assert_allclose(source.block(0, 1)[0], frame, atol=2 if ending == "jpg" else 0)
            assert ("equal" in source.note) == (mode != "L")


def test_colours_that_differ(tmp_path: Path) -> None:
    values = np.zeros((6, 8, 3), np.uint8)
    values[0, 0] = 1, 2, 3
    for ending in ("png", "bmp", "tif"):
        path = tmp_path / f"a.{ending}"
        Image.fromarray(values).save(path)
        with refused(path.name, "2.08 %"), open_frames([path]) as source:
            source.block(0, 1)
        if ending != "tif":
            for number, colour in enumerate(("red", "green", "blue")):
                assert_frames(f"{path}:{colour}", values[None, ..., number])


def test_several_pages_in_equal_colours(tmp_path: Path) -> None:
    frames = cube(3).astype("u2")
    tifffile.imwrite(tmp_path / "a.tif", np.repeat(frames[..., None], 3, axis=-1), photometric="rgb")
    assert_frames(tmp_path / "a.tif", frames)
