"""HDF5, MATLAB and image files: tests beyond those of every format."""

from pathlib import Path

import numpy as np
import pytest
import scipy.io
from PIL import Image
from tests.io.frame_files import cube, h5py, save, tifffile
from tests.refusals import refused

from faintspot.io import open_frames, read_array


class TestMatlab:
    @pytest.mark.parametrize("name", ["mat", "7.3.mat"])
    def test_matrices_are_as_matlab_has_them(self, tmp_path: Path, name: str) -> None:
        path = save(tmp_path / f"a.{name}", cube())
        matrix = np.arange(12.0).reshape(3, 4)
        if name == "mat":
            scipy.io.savemat(path, {"matrix": matrix, "text": "abc", "cell": np.array([[1, "a"]], object)})
        else:
            with h5py.File(path, "r+") as file:
                file["matrix"], file["#refs#/a"] = matrix.T, cube()
        np.testing.assert_array_equal(read_array(f"{path}:matrix"), matrix)

    @pytest.mark.parametrize("kind", ["u1", "i2", "u2", "f4", "f8", "?"])
    def test_matlab_types_are_kept(self, tmp_path: Path, kind: str) -> None:
        values = cube(4).astype(kind)
        scipy.io.savemat(tmp_path / "a.mat", {"b": np.moveaxis(values, 0, -1)})
        with open_frames([tmp_path / "a.mat"]) as source:
            assert source.dtype == (np.uint8 if kind == "?" else kind)
            np.testing.assert_array_equal(source.block(1, 3), values[1:3])


class TestImages:
    @pytest.mark.parametrize("kind", ["u1", "u2"])
    def test_grey_png_files_are_frames(self, tmp_path: Path, kind: str) -> None:
        frames = cube(2).astype(kind)
        paths = [tmp_path / "a.png", tmp_path / "b.png"]
        for path, frame in zip(paths, frames, strict=True):
            Image.fromarray(frame).save(path)
        with open_frames(paths) as source:
            assert source.dtype == kind
            np.testing.assert_array_equal(source.block(0, 2), frames)

    @pytest.mark.parametrize("ending", ["png", "bmp", "jpg", "tif"])
    @pytest.mark.parametrize("mode", ["L", "RGB", "RGBA"])
    def test_grey_in_any_mode(self, tmp_path: Path, ending: str, mode: str) -> None:
        path, frame = tmp_path / f"a.{ending}", np.full((16, 24), 7, np.uint8)
        frame[8:, 8:16] = 200  # whole blocks, which JPEG keeps
        image = Image.fromarray(frame)
        image.convert("RGB" if ending == "jpg" and mode != "L" else mode).save(path)
        with open_frames([path]) as source:
            assert (source.n_frames, source.dtype) == (1, np.dtype(np.uint8))
            np.testing.assert_allclose(source.block(0, 1)[0], frame, atol=2 if ending == "jpg" else 0)
            assert ("equal" in source.note) == (mode != "L")

    @pytest.mark.parametrize("ending", ["png", "bmp", "tif"])
    def test_colours_that_differ(self, tmp_path: Path, ending: str) -> None:
        path, values = tmp_path / f"a.{ending}", np.zeros((6, 8, 3), np.uint8)
        values[0, 0] = 1, 2, 3
        Image.fromarray(values).save(path)
        with refused(path.name, "colours differ in 2.08 %", "one"), open_frames([path]) as source:
            source.block(0, 1)
        if ending != "tif":
            with open_frames([f"{path}:green"]) as source:
                np.testing.assert_array_equal(source.block(0, 1)[0], values[..., 1])

    def test_several_pages_in_equal_colours(self, tmp_path: Path) -> None:
        frames = cube(3).astype("u2")
        tifffile.imwrite(tmp_path / "a.tif", np.repeat(frames[..., None], 3, axis=-1), photometric="rgb")
        with open_frames([tmp_path / "a.tif"]) as source:
            np.testing.assert_array_equal(source.block(0, 3), frames)
