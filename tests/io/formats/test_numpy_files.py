"""NumPy's files and text files: tests beyond those of every format."""

import zipfile
from itertools import product
from pathlib import Path

import numpy as np
from tests.io.frame_files import assert_frames, cube, save
from tests.refusals import refused

from faintspot.io import open_frames, read_array


def test_file_cut_while_it_is_read(tmp_path: Path) -> None:
    path = save(tmp_path / "a.npy", cube())
    with open_frames([path]) as source:
        path.write_bytes(path.read_bytes()[: 128 + 4 * 96 + 10])
        np.testing.assert_array_equal(source.block(0, 4), cube()[:4])
        with refused("frames 4 to 10 "):
            source.block(4, 11)


def test_fortran_order_in_npz(tmp_path: Path) -> None:
    frame = np.asfortranarray(cube()[0])
    np.savez(tmp_path / "a.npz", frame)
    np.testing.assert_array_equal(read_array(tmp_path / "a.npz"), frame)


def test_zip_with_other_files_in_it(tmp_path: Path) -> None:
    path = save(tmp_path / "a.npz", cube())
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("notes.txt", "hello")
    assert_frames(path, cube())


def test_text_files_have_any_separator(tmp_path: Path) -> None:
    poke = np.random.default_rng(3).standard_normal((14, 5))
    for separator, ending in product([",", ";", " ", "\t"], ["txt", "csv", "dat", "TXT"]):
        path = tmp_path / f"poke.{ending}"
        np.savetxt(path, poke, delimiter=separator, header="poke matrix", fmt="%.17g")
        np.testing.assert_array_equal(read_array(path), poke)


def test_names_comments_and_empty_fields(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("\ufeffx,y,z\n# by hand\n1,,3\n\n4,5,nan  # last\n")
    np.testing.assert_array_equal(read_array(path), [[1, np.nan, 3], [4, 5, np.nan]])
    path.write_text("\ufeff1 2\n")
    np.testing.assert_array_equal(read_array(path), [[1, 2]])
