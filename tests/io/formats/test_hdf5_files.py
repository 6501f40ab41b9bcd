"""HDF5, MATLAB and IDL files: tests beyond those of every format."""

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from tests.io import idl_file
from tests.io.frame_files import assert_frames, cube, h5py, save
from tests.refusals import refused

from faintspot.io import read_array, stored_array
from faintspot.io.formats import hdf5_files

GAIN = np.arange(12, dtype=np.float32).reshape(3, 4)
FIELDS: dict[str, np.ndarray] = {
    "DMCOMMAND": np.arange(24.0).reshape(4, 6).astype(np.float32),
    "TIMESTAMP": np.arange(4, dtype=np.int64) * 20_000,
    "COUNTS": np.arange(6, dtype=np.int16).reshape(3, 2),
    "BITS": np.arange(5, dtype=np.uint8),
}


@pytest.mark.parametrize("compressed", [False, True])
def test_variables_and_fields(tmp_path: Path, compressed: bool) -> None:
    path = idl_file.write(tmp_path / "trs.sav", {"rx": GAIN, "nrec": np.int16(1), "A": FIELDS}, compressed)
    np.testing.assert_array_equal(read_array(f"{path}:RX"), GAIN)
    for name, values in FIELDS.items():
        stored = read_array(f"{path}:a.{name.lower()}")
        np.testing.assert_array_equal(stored, values)
        assert stored.dtype == values.dtype
    assert {"RX", "NREC", "A.DMCOMMAND"} <= set(hdf5_files.Idl().names(path))


def test_idl_records_that_inflate_too_far(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Records that inflate to more than the limit, here 1 MiB, are not inflated."""
    monkeypatch.setattr(hdf5_files, "MOST_WHOLE_BYTES", 1 << 20)
    assert stored_array.MOST_WHOLE_BYTES == 1 << 30
    body = zlib.compress(bytes(3 << 20))
    content = b"SR\0\6" + struct.pack(">iIII", 2, 20 + len(body), 0, 0) + body
    path = tmp_path / "trs.sav"
    path.write_bytes(content + struct.pack(">iIII", 6, 0, 0, 0))
    with refused("trs.sav", "1 MiB"):
        read_array(f"{path}:RX")


@pytest.mark.parametrize("name", ["mat", "7.3.mat"])
def test_matrices_are_as_matlab_has_them(tmp_path: Path, name: str) -> None:
    path = save(tmp_path / f"a.{name}", cube())
    matrix = np.arange(12.0).reshape(3, 4)
    if name == "mat":
        scipy.io.savemat(path, {"matrix": matrix, "text": "abc", "cell": np.array([[1, "a"]], object)})
    else:
        with h5py.File(path, "r+") as file:
            file["matrix"], file["#refs#/a"] = matrix.T, cube()
    np.testing.assert_array_equal(read_array(f"{path}:matrix"), matrix)


def test_matlab_types_are_kept(tmp_path: Path) -> None:
    for kind in ("u1", "i2", "u2", "f4", "f8", "?"):
        values = cube(4).astype(kind)
        scipy.io.savemat(tmp_path / "a.mat", {"b": np.moveaxis(values, 0, -1)})
        assert_frames(tmp_path / "a.mat", values.astype(np.uint8) if kind == "?" else values)
