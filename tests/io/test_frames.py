"""Frames of several files as one sequence, axes that count the frames, colours, and whole arrays."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
from hypothesis import given
from hypothesis import strategies as st
from tests.io.frame_files import assert_frames, cube, fits, h5py, save, zarr
from tests.refusals import refused

from faintspot.io import open_frames, read_array


class TestSequence:
    @given(st.data())
    def test_concatenation_of_files(self, tmp_path_factory: pytest.TempPathFactory, data: Any) -> None:
        folder = tmp_path_factory.mktemp("parts")
        counts = data.draw(st.lists(st.integers(1, 4), min_size=1, max_size=4))
        frames = cube(sum(counts))
        endings = st.lists(
            st.sampled_from(["npy", "npz", "fits.gz"]), min_size=len(counts), max_size=len(counts)
        )
        ends = np.cumsum(counts)
        paths = [
            save(folder / f"{i}.{ending}", frames[end - count : end])
            for i, (ending, count, end) in enumerate(zip(data.draw(endings), counts, ends, strict=True))
        ]
        start = data.draw(st.integers(0, len(frames) - 1))
        stop = data.draw(st.integers(start + 1, len(frames)))
        with open_frames(paths) as source:
            assert source.n_frames == len(frames)
            np.testing.assert_array_equal(source.block(start, stop), frames[start:stop])

    def test_different_types_are_promoted(self, tmp_path: Path) -> None:
        paths = [save(tmp_path / "a.npy", cube()), save(tmp_path / "b.npy", cube(dtype="float32"))]
        with open_frames(paths) as source:
            assert source.dtype == np.float32
            assert source.block(0, 1).dtype == np.float32
            assert source.description.endswith("a.npy and 1 more")

    def test_other_size_and_range(self, tmp_path: Path) -> None:
        a, b = save(tmp_path / "a.npy", cube()), save(tmp_path / "b.npy", cube(2, 6, 9))
        with refused("b.npy", "6 x 9", "a.npy", "6 x 8"):
            open_frames([a, b])
        with open_frames([a]) as source:
            for start, stop in [(-1, 2), (3, 3), (5, 12)]:
                with refused("expected 0 to 11"):
                    source.block(start, stop)
        with refused("at least one file"):
            open_frames([])


class TestReadArray:
    def test_any_dimensions_and_bool(self, tmp_path: Path) -> None:
        mask = cube()[0] > 0
        np.savez(tmp_path / "a.npz", mask=mask, line=np.arange(5.0))
        np.testing.assert_array_equal(read_array(f"{tmp_path / 'a.npz'}:mask"), mask)
        np.testing.assert_array_equal(read_array(f"{tmp_path / 'a.npz'}:line"), np.arange(5.0))


# Which axis counts the frames

FRAMES_FIRST = [(50, 220, 220), (300, 220, 220), (100, 240, 200), (60, 6, 8), (4, 4, 4), (20, 48, 64)]
FRAMES_ELSEWHERE = [((220, 220, 50), 2), ((64, 48, 1), 2), ((220, 50, 220), 1)]
AMBIGUOUS = [((220, 220, 150), 2), ((200, 220, 50), 2), ((220, 150, 220), 1)]


def stored(folder: Path, shape: tuple[int, ...]) -> tuple[Path, np.ndarray]:
    cube = np.random.default_rng(1).integers(0, 250, shape, np.uint8)
    np.save(folder / "a.npy", cube)
    return folder / "a.npy", cube


def test_time_axis_is_recognised_or_stated(tmp_path: Path) -> None:
    for shape, axis in (*((shape, 0) for shape in FRAMES_FIRST), *FRAMES_ELSEWHERE):
        path, cube = stored(tmp_path, shape)
        note = assert_frames(path, np.moveaxis(cube, axis, 0))
        assert (f"taken for {shape[axis]} frames" in note) == bool(note) == (axis > 0)
    for shape, axis in AMBIGUOUS:
        path, cube = stored(tmp_path, shape)
        for chosen in (0, axis):
            assert not assert_frames(path, np.moveaxis(cube, chosen, 0), time_axis=chosen)


def test_matlab_cubes_with_frames_first(tmp_path: Path) -> None:
    _, cube = stored(tmp_path, (5, 40, 40))
    scipy.io.savemat(tmp_path / "a.mat", {"frames": cube})
    assert_frames(tmp_path / "a.mat", cube)


def test_axes_of_length_one(tmp_path: Path) -> None:
    for shape in ((1, 1, 6, 8), (1, 5, 6, 8), (5, 1, 6, 8), (5, 6, 8, 1), (1, 5, 1, 6, 8)):
        path, cube = stored(tmp_path, shape)
        assert_frames(path, cube.reshape(-1, 6, 8))


# Colours, and files with several images

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
