import zipfile
from pathlib import Path

import numpy as np
from tests.io.frame_files import cube, save
from tests.refusals import refused

from faintspot.io import open_frames, read_array


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


def test_zip_with_other_files_in_it(tmp_path: Path) -> None:
    path = save(tmp_path / "a.npz", cube())
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("notes.txt", "hello")
    with open_frames([path]) as source:
        assert source.n_frames == 11
