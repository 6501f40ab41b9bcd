"""Frames in colours, and files with several images."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
from tests.io.frame_files import assert_frames
from tests.refusals import refused

from faintspot.io import open_frames, read_array

fits = pytest.importorskip("astropy.io.fits")
h5py: Any = pytest.importorskip("h5py")
zarr = pytest.importorskip("zarr")

COLOURS = np.random.default_rng(1).integers(0, 250, (5, 16, 24, 3)).astype(np.uint8)


def _hdf5(path: Path, frames: np.ndarray) -> None:
    with h5py.File(path, "w") as file:
        file.create_dataset("camera/images", data=frames, chunks=(1, *frames.shape[1:]), compression="gzip")


SAVE: dict[str, Callable[[Path, np.ndarray], Any]] = {
    "a.npy": np.save,
    "a.npz": lambda path, frames: np.savez(path, images=frames),
    "a.h5": _hdf5,
    "a.zarr": lambda path, frames: zarr.create_array(str(path), data=frames),
    "a.fits": lambda path, frames: fits.PrimaryHDU(frames).writeto(path),
    "a.mat": lambda path, frames: scipy.io.savemat(path, {"images": np.moveaxis(frames, 0, -1)}),
}


@pytest.fixture(params=[-1, 1], ids=["last", "second"])
def saved(request: pytest.FixtureRequest) -> np.ndarray:
    """Return the frames with the colours along the last or the second axis."""
    return np.moveaxis(COLOURS, -1, request.param)


@pytest.mark.parametrize("name", SAVE)
def test_a_colour_is_selected_by_its_name(tmp_path: Path, saved: np.ndarray, name: str) -> None:
    path = tmp_path / name
    SAVE[name](path, saved)
    for number, colour in enumerate(("red", "green", "blue")):
        assert_frames(f"{path}:{colour}", COLOURS[..., number])
    with open_frames([path]) as source, refused(f"{name}", ":green"):
        source.block(0, 5)
    assert_frames(path, COLOURS[..., 2], key="blue")


@pytest.mark.parametrize("name", SAVE)
def test_equal_colours_are_grey(tmp_path: Path, saved: np.ndarray, name: str) -> None:
    axis = saved.shape.index(3)
    SAVE[name](tmp_path / name, saved.take([0, 0, 0], axis))
    assert "equal" in assert_frames(tmp_path / name, COLOURS[..., 0])


def test_a_colour_of_a_named_array(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    np.savez(path, dark=np.zeros((16, 24)), flat=np.ones((16, 24)), images=COLOURS)
    assert_frames(f"{path}:images:green", COLOURS[..., 1])


def test_fits_files_whose_primary_has_no_image(tmp_path: Path) -> None:
    """One extension with an image is it; several are listed with their shapes."""
    frames = COLOURS[..., 0]
    one, two = tmp_path / "one.fits", tmp_path / "two.fits"
    extension = fits.ImageHDU(frames, name="SCI")
    fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(np.zeros(3), name="TIMES"), extension]).writeto(one)
    fits.HDUList([fits.PrimaryHDU(), extension, fits.ImageHDU(frames[0])]).writeto(two)
    with open_frames([one]) as source:
        np.testing.assert_array_equal(source.block(0, 5), frames)
        assert source.description == f"{one}:SCI"
    np.testing.assert_array_equal(read_array(f"{two}:2"), frames[0])
