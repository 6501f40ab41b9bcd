"""Frames of several files as one sequence, whole arrays, and refused files of no particular format."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from tests.io.frame_files import cube, h5py, save, zarr
from tests.refusals import refused

from faintspot.io import open_frames, read_array, read_slopes
from faintspot.io.slopes import read_reference
from faintspot.slopes.spots.psf import PSF


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


@pytest.mark.parametrize(
    ("name", "part"),
    [
        ("missing.fits", "no such file"),
        ("missing.npz:frames", "no such file"),
        ("empty.fits", "empty"),
        ("text.log", "MATLAB"),
        ("folder", "expected a Zarr store"),
        ("short.npy", "expected a whole .npy file"),
        ("cut.npy", "truncated"),
        ("cut.npy:frames", "one unnamed"),
    ],
)
def test_paths_that_hold_no_frames_are_refused(tmp_path: Path, name: str, part: str) -> None:
    (tmp_path / "empty.fits").touch()
    (tmp_path / "text.log").write_text("some text")
    (tmp_path / "folder").mkdir()
    (tmp_path / "short.npy").write_bytes(b"\x93NUMPY")
    cut = save(tmp_path / "cut.npy", cube())
    cut.write_bytes(cut.read_bytes()[:-10])
    with refused(name.partition(":")[0], part):
        open_frames([tmp_path / name])


READERS: list[Callable[[Path], Any]] = [
    lambda path: open_frames([path]),
    read_array,
    PSF.load,
    read_reference,
]


@pytest.mark.parametrize("kind", ["pipe", "device"])
@pytest.mark.parametrize("ending", ["npz", "fits", "csv", "npy"])
def test_no_regular_file(tmp_path: Path, ending: str, kind: str) -> None:
    path = tmp_path / f"a.{ending}"
    if kind == "pipe":
        os.mkfifo(path)
    else:
        path.symlink_to("/dev/zero")
    for read in READERS if ending == "npy" else [*READERS, read_slopes]:
        with refused(f"{path}: expected a regular file"):
            read(path)


def test_several_arrays_are_listed(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", one=cube(), two=cube(), flat=np.ones(3))
    group = zarr.create_group(str(tmp_path / "a.zarr"))
    group.create_array("one", data=cube())
    group.create_array("two", data=cube())
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["one"], file["two"], file["group/flat"] = cube(), cube(), np.ones(3)
    with refused("no array 'group'"):
        open_frames([f"{tmp_path / 'a.h5'}:group"])
    for path in (tmp_path / "a.npz", tmp_path / "a.zarr", tmp_path / "a.h5"):
        with refused(path.name, "one", "two", f"{path.name}:NAME"):
            open_frames([path])
        with refused(path.name, "three"):
            open_frames([f"{path}:three"])
        with open_frames([path], key="two") as source:
            assert source.n_frames == 11


class TestReadArray:
    def test_any_dimensions_and_bool(self, tmp_path: Path) -> None:
        mask = cube()[0] > 0
        np.savez(tmp_path / "a.npz", mask=mask, line=np.arange(5.0))
        np.testing.assert_array_equal(read_array(f"{tmp_path / 'a.npz'}:mask"), mask)
        np.testing.assert_array_equal(read_array(f"{tmp_path / 'a.npz'}:line"), np.arange(5.0))

    @pytest.mark.parametrize("array", [np.zeros((2, 2), complex), np.zeros((0, 3)), np.float64(1)])
    def test_arrays_that_are_no_numbers_are_refused(self, tmp_path: Path, array: NDArray[Any]) -> None:
        np.save(tmp_path / "a.npy", array)
        with refused("a.npy", "expected"):
            read_array(tmp_path / "a.npy")
