"""NumPy's .npy and .npz files: frames, never unpickled and never read whole; slopes in .npz."""

from __future__ import annotations

import json
import math
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from faintspot.errors import InputError
from faintspot.files import parse_json
from faintspot.io.file_format import FileFormat
from faintspot.io.locations import PREFERRED_NAME, StoredArray, choose_name, one_line
from faintspot.io.raw import DAMAGE, MappedArray, RawArray, pieces
from faintspot.io.slopes_format import REQUIRED, VARIABLES, StoredSlopes, with_absent


@dataclass(frozen=True)
class _Header:
    shape: tuple[int, ...]
    fortran_order: bool
    dtype: np.dtype[Any]
    offset: int

    @property
    def total_bytes(self) -> int:
        return self.offset + math.prod(self.shape) * self.dtype.itemsize


class Npy(FileFormat):
    """Frames in a .npy file."""

    name = ".npy"
    signatures = (b"\x93NUMPY",)

    def find(self, path: Path, key: str | None) -> StoredArray:
        """Return the array of the file."""
        return _find_npy(path, key)


class Npz(FileFormat):
    """Frames in an array of a .npz file; slopes with every quantity in an array of its name."""

    name = ".npz"
    signatures = (b"PK\x03\x04",)
    endings = (".npz",)

    def find(self, path: Path, key: str | None) -> StoredArray:
        """Return an array of the file, streamed from its zip member."""
        return _find_npz(path, key)

    def write(self, stream: IO[bytes], slopes: StoredSlopes) -> None:
        """Write every variable and coordinate, and the attributes as a JSON text named `attributes`."""
        arrays = {**slopes.variables, **slopes.coordinates}
        arrays["attributes"] = np.array(json.dumps(dict(slopes.attributes)))
        with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            for name, array in arrays.items():
                with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                    header = {
                        "descr": np.lib.format.dtype_to_descr(array.dtype),
                        "fortran_order": False,
                        "shape": array.shape,
                    }
                    np.lib.format.write_array_header_1_0(member, header)
                    for piece in pieces(array):
                        member.write(piece.tobytes())

    def read(self, path: Path) -> StoredSlopes:
        """Read a file of slopes; zip verifies the checksum of each array."""
        # numpy.load leaves a file that it opened itself open when the archive is damaged.
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        variables = with_absent({name: arrays.pop(name) for name in VARIABLES if name in arrays})
        attributes = parse_json(str(arrays.pop("attributes")))
        return StoredSlopes(variables, arrays, attributes, True, len(variables["x"]))

    def has_slopes(self, path: Path) -> bool:
        """Tell by the names of the arrays."""
        try:
            with zipfile.ZipFile(path) as archive:
                return {f"{name}.npy" for name in (*REQUIRED, "attributes")} <= set(archive.namelist())
        except DAMAGE:
            return False  # whoever reads it says what is wrong with it


def _find_npy(path: Path, key: str | None) -> StoredArray:
    """Return the array of a .npy file.

    Raises
    ------
    InputError
        When the file is not whole, holds Python objects, or a key is given.
    """
    if key is not None:
        raise InputError(f"{path}: a .npy file holds one array without a name, got key {key!r}")
    with path.open("rb") as stream:
        header = _read_header(str(path), stream)
    _check(str(path), header, path.stat().st_size)
    if header.fortran_order and len(header.shape) > 1:
        return MappedArray(str(path), np.load(path, mmap_mode="r", allow_pickle=False))
    return RawArray(
        str(path),
        lambda: path.open("rb"),
        offset=header.offset,
        dtype=header.dtype,
        shape=header.shape,
        forward_only=False,
    )


def _find_npz(path: Path, key: str | None) -> StoredArray:
    """Return one array of a .npz file, streamed from its zip member.

    Raises
    ------
    InputError
        When the file is damaged, or has no such array, or several and no key is given.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            members = {
                name.removesuffix(".npy"): name for name in archive.namelist() if name.endswith(".npy")
            }
            wanted = _candidates(members, key)
            headers = {}
            for name, member in wanted.items():
                with archive.open(member) as stream:
                    headers[name] = _read_header(f"{path}:{name}", stream)
            dimensions = dict.fromkeys(members, 0) | {
                name: len(header.shape) for name, header in headers.items()
            }
            chosen = choose_name(path, dimensions, key)
            member_bytes = archive.getinfo(members[chosen]).file_size
    except DAMAGE as error:
        raise InputError(f"{path}: expected a whole .npz file, which it is not ({one_line(error)})") from None
    return _npz_array(path, chosen, members[chosen], headers[chosen], member_bytes)


def _candidates(members: dict[str, str], key: str | None) -> dict[str, str]:
    """Return the members whose headers decide which one to read; all of them only when nothing is named."""
    name = key if key is not None else PREFERRED_NAME
    if name in members:
        return {name: members[name]}
    return members if key is None else {}


def _npz_array(path: Path, key: str, member: str, header: _Header, member_bytes: int) -> StoredArray:
    """Return the array of a zip member; Fortran order cannot be streamed by frame, only loaded."""
    name = f"{path}:{key}"
    _check(name, header, member_bytes)
    if header.fortran_order and len(header.shape) > 1:
        if len(header.shape) > 2:
            raise InputError(
                f"{name}: stored in Fortran order, which cannot be read frame by frame: "
                "save numpy.ascontiguousarray of it"
            )
        with np.load(path, allow_pickle=False) as archive:
            return MappedArray(name, archive[key])

    def open_member() -> IO[bytes]:
        # The member keeps the file open after the archive object is closed.
        with zipfile.ZipFile(path) as archive:
            return archive.open(member)

    return RawArray(
        name, open_member, offset=header.offset, dtype=header.dtype, shape=header.shape, forward_only=True
    )


def _read_header(name: str, stream: IO[bytes]) -> _Header:
    """Read the header that starts every .npy file and .npz member."""
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    try:
        version = np.lib.format.read_magic(stream)
        shape, fortran_order, dtype = readers[version](stream)
    except KeyError:
        raise InputError(f"{name}: expected .npy format version 1 or 2, got another") from None
    except DAMAGE:
        raise
    except Exception as error:  # NumPy evaluates the header as Python, which fails in many ways
        raise InputError(f"{name}: expected a NumPy array ({one_line(error)})") from None
    return _Header(shape, fortran_order, dtype, stream.tell())


def _check(name: str, header: _Header, actual_bytes: int) -> None:
    if header.dtype.hasobject:
        raise InputError(f"{name}: expected numbers, got Python objects, which are never unpickled")
    if any(side < 0 for side in header.shape):
        raise InputError(f"{name}: damaged: its header has the shape {header.shape}")
    if actual_bytes < header.total_bytes:
        raise InputError(
            f"{name}: truncated: its header promises {header.total_bytes} bytes, there are {actual_bytes}"
        )
