"""NumPy's .npy and .npz files: frames, read in parts and without unpickling; slopes in .npz."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.base.files import check_regular, unpacked
from faintspot.base.flags import VARIABLES
from faintspot.base.text_files import parse_json, to_json
from faintspot.io.file_format import REQUIRED, FileFormat, StoredSlopes, most_slopes_bytes, with_absent
from faintspot.io.fits_units import StreamedArray, check_present
from faintspot.io.stored_array import MOST_WHOLE_BYTES, PREFERRED_NAME, StoredArray, choose_name

_PIECE_NUMBERS = 1 << 18


class Npy(FileFormat):
    """Frames in a .npy file."""

    name = ".npy"
    signatures = (b"\x93NUMPY",)

    def find(self, path: Path, key: str | None) -> StoredArray:
        """Return the array of a .npy file.

        Raises
        ------
        InputError
            When the file is incomplete, holds Python objects, or a key is given.
        """
        if key is not None:
            raise InputError(f"{path}: a .npy file holds one unnamed array, expected no key, got {key!r}")
        with path.open("rb") as stream:
            header = _Header.read(str(path), stream)
        check_present(str(path), path, header.offset + math.prod(header.shape) * header.dtype.itemsize)

        def open_array(files: ExitStack) -> object:
            if header.fortran_order:
                return np.load(path, mmap_mode="r", allow_pickle=False)
            return StreamedArray(
                files.enter_context(path.open("rb")), header.offset, header.dtype, header.shape
            )

        return StoredArray(str(path), header.shape, header.dtype, open_array)


class Npz(FileFormat):
    """Frames in an array of a .npz file; slopes with each quantity in an array of its name."""

    name = ".npz"
    signatures = (b"PK\x03\x04",)
    endings = (".npz",)

    def find(self, path: Path, key: str | None) -> StoredArray:
        """Return one array of a .npz file, streamed from its zip member.

        Raises
        ------
        InputError
            When the file has no such array, has several and no key is given, or has a cube in Fortran order,
            which cannot be read by frame.
        """
        with zipfile.ZipFile(path) as archive:
            members = _members(archive)
            wanted = PREFERRED_NAME if key is None else key
            # Without a name, the headers decide which array to read.
            chosen = [wanted] if wanted in members else list(members)
            headers = {}
            for name in chosen:
                with archive.open(members[name]) as stream:
                    headers[name] = _Header.read(f"{path}:{name}", stream)
        shapes = {name: headers[name].shape if name in headers else () for name in members}
        name = choose_name(path, shapes, key)
        member, header = members[name], headers[name]
        if header.fortran_order and len(header.shape) > 2:
            raise InputError(
                f"{path}:{name}: stored in Fortran order, which cannot be read frame by frame: "
                "save numpy.ascontiguousarray of it"
            )
        if header.fortran_order:
            return StoredArray.whole(
                f"{path}:{name}",
                header.shape,
                header.dtype,
                lambda: unpacked(path, "a frame", [name], MOST_WHOLE_BYTES)[name],
            )

        def open_array(files: ExitStack) -> object:
            archive = files.enter_context(zipfile.ZipFile(path))
            stream = files.enter_context(archive.open(member))
            return StreamedArray(stream, header.offset, header.dtype, header.shape, compressed=True)

        return StoredArray(f"{path}:{name}", header.shape, header.dtype, open_array)

    def write(self, stream: IO[bytes], slopes: StoredSlopes) -> None:
        """Write each variable and coordinate, and the attributes as a JSON text named `attributes`."""
        arrays = {**slopes.variables, **slopes.coordinates}
        arrays["attributes"] = np.array(to_json(slopes.attributes))
        with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            for name, array in arrays.items():
                with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                    header = {
                        "descr": np.lib.format.dtype_to_descr(array.dtype),
                        "fortran_order": False,
                        "shape": array.shape,
                    }
                    np.lib.format.write_array_header_1_0(member, header)
                    for piece in _pieces(array):
                        member.write(piece.tobytes())

    def read(self, path: Path) -> StoredSlopes:
        """Read a file of slopes; zip verifies the checksum of each array."""
        arrays = unpacked(path, "slopes", None, most_slopes_bytes())
        variables = with_absent({name: arrays.pop(name) for name in VARIABLES if name in arrays})
        attributes = parse_json(str(arrays.pop("attributes")))
        return StoredSlopes(variables, arrays, attributes, True, len(variables["x"]))

    def has_slopes(self, path: Path) -> bool:
        """Return whether the arrays have the names of slopes."""
        check_regular(path)
        try:
            with zipfile.ZipFile(path) as archive:
                return {*REQUIRED, "attributes"} <= _members(archive).keys()
        except Exception:  # zip raises several kinds of errors on damaged files
            return False  # the reader of arrays gives the reason


class _Header(NamedTuple):
    """Header of a .npy file, or of a member of a .npz file."""

    shape: tuple[int, ...]
    fortran_order: bool
    dtype: np.dtype[Any]
    offset: int

    @classmethod
    def read(cls, name: str, stream: IO[bytes]) -> _Header:
        """Read the header at the start of a stream; refuse Python objects."""
        readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
        shape, fortran_order, dtype = readers[np.lib.format.read_magic(stream)](stream)
        if dtype.hasobject:
            raise InputError(f"{name}: expected numbers, got Python objects, which are never unpickled")
        return cls(shape, fortran_order and len(shape) > 1, dtype, stream.tell())


def _members(archive: zipfile.ZipFile) -> dict[str, zipfile.ZipInfo]:
    """Return the members of a .npz file by array name."""
    members = [item for item in archive.infolist() if item.filename.endswith(".npy")]
    return {item.filename.removesuffix(".npy"): item for item in members}


def _pieces(array: NDArray[np.generic]) -> Iterator[NDArray[np.generic]]:
    """Yield an array in pieces of bounded size along its first axis."""
    if not array.shape:
        yield array
        return
    step = max(1, _PIECE_NUMBERS // max(1, math.prod(array.shape[1:])))
    for start in range(0, array.shape[0], step):
        yield array[start : start + step]
