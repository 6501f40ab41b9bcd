import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.io.frame_files import cube, save
from tests.refusals import refused

from faintspot.io import open_frames, read_array


@pytest.mark.parametrize(
    ("array", "parts"),
    [
        (np.zeros((2, 3, 4), complex), ("dtype complex128",)),
        (np.zeros((2, 3, 4), "U3"), ("dtype <U3",)),
        (np.zeros((2, 3, 4), bool), ("dtype bool",)),
        (np.zeros((2, 2, 3, 5)), ("(2, 2, 3, 5)",)),
        (np.zeros(5), ("(5,)",)),
        (np.zeros((0, 3, 4)), ("at least one frame", "(0, 3, 4)")),
        (np.array([[None]]), ("Python objects",)),
        (np.float64(3), ("single number",)),
    ],
)
@pytest.mark.parametrize("ending", ["npy", "npz"])
def test_no_frames(tmp_path: Path, array: NDArray[Any], parts: tuple[str, ...], ending: str) -> None:
    path = tmp_path / f"a.{ending}"
    if ending == "npy":
        np.save(path, array, allow_pickle=True)
    else:
        np.savez(path, frames=array)
    with refused(path.name, *parts):
        open_frames([path])


def test_negative_shape_is_refused(tmp_path: Path) -> None:
    """Two negative sides make a size that a file can have."""
    with (tmp_path / "a.npy").open("wb") as file:
        header = {"descr": "<f4", "fortran_order": True, "shape": (-3, -4)}
        np.lib.format.write_array_header_1_0(file, header)
        file.write(bytes(48))
    with refused("at least one frame", "(-3, -4)"):
        open_frames([tmp_path / "a.npy"])


def test_file_cut_while_it_is_read(tmp_path: Path) -> None:
    path = save(tmp_path / "a.npy", cube())
    with open_frames([path]) as source:
        path.write_bytes(path.read_bytes()[: 128 + 4 * 96 + 10])
        np.testing.assert_array_equal(source.block(0, 4), cube()[:4])
        with refused("frames 4 to 10 ", "end too early"):
            source.block(4, 11)


def test_fortran_order_in_npz(tmp_path: Path) -> None:
    frame = np.asfortranarray(cube()[0])
    np.savez(tmp_path / "a.npz", frame)
    np.testing.assert_array_equal(read_array(tmp_path / "a.npz"), frame)
    np.savez(tmp_path / "b.npz", np.asfortranarray(cube()))
    with refused("b.npz:arr_0", "Fortran order", "ascontiguousarray"):
        open_frames([tmp_path / "b.npz"])


def test_zip_with_other_files_in_it(tmp_path: Path) -> None:
    path = save(tmp_path / "a.npz", cube())
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("notes.txt", "hello")
    with open_frames([path]) as source:
        assert source.n_frames == 11
