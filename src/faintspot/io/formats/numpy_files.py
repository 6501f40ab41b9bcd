"""NumPy's .npy and .npz files: frames, read in parts and without unpickling; slopes in .npz."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import IO

import numpy as np

from faintspot.base.errors import InputError
from faintspot.base.files import parse_json
from faintspot.base.npz import DAMAGE, Header, headers_of, open_archive, read_header, unpacked
from faintspot.io.arrays.raw import MOST_WHOLE_BYTES, MappedArray, RawArray, WholeArray, pieces
from faintspot.io.formats.file_format import FileFormat
from faintspot.io.locations import PREFERRED_NAME, StoredArray, choose_name, one_line
from faintspot.io.stored.slopes_format import (
    REQUIRED,
    VARIABLES,
    StoredSlopes,
    check_stated,
    most_slopes_bytes,
    with_absent,
)


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
            header = read_header(str(path), stream, path.stat().st_size)
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
            When the file is damaged, has no such array, or has several and no key is given.
        """
        try:
            archive, members = open_archive(path)
            archive.close()
            wanted = PREFERRED_NAME if key is None else key
            # Without a name, the headers decide which array to read.
            headers = headers_of(path, [wanted] if wanted in members or key is not None else None)
        except DAMAGE as error:
            raise InputError(f"{path}: expected a valid .npz file ({one_line(error)})") from None
        dimensions = {name: len(headers[name].shape) if name in headers else 0 for name in members}
        chosen = choose_name(path, dimensions, key)
        return _npz_array(path, chosen, members[chosen], headers[chosen])

    def write(self, stream: IO[bytes], slopes: StoredSlopes) -> None:
        """Write each variable and coordinate, and the attributes as a JSON text named `attributes`."""
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
        shapes = {name: header.shape for name, header in headers_of(path).items()}
        shapes.pop("attributes")
        check_stated(path, shapes)
        arrays = unpacked(path, "slopes", most=most_slopes_bytes())
        variables = with_absent({name: arrays.pop(name) for name in VARIABLES if name in arrays})
        attributes = parse_json(str(arrays.pop("attributes")))
        return StoredSlopes(variables, arrays, attributes, True, len(variables["x"]))

    def has_slopes(self, path: Path) -> bool:
        """Return whether the arrays have the names of slopes."""
        try:
            archive, members = open_archive(path)
        except DAMAGE:
            return False  # its reader gives the reason
        archive.close()
        return {*REQUIRED, "attributes"} <= members.keys()


def _npz_array(path: Path, key: str, member: zipfile.ZipInfo, header: Header) -> StoredArray:
    """Return the array of a zip member; one in Fortran order cannot be read by frame, only as a whole."""
    name = f"{path}:{key}"
    if header.fortran_order and len(header.shape) > 1:
        if len(header.shape) > 2:
            raise InputError(
                f"{name}: stored in Fortran order, which cannot be read frame by frame: "
                "save numpy.ascontiguousarray of it"
            )
        return WholeArray(
            name, header.shape, header.dtype, lambda: unpacked(path, "a frame", [key], MOST_WHOLE_BYTES)[key]
        )

    def open_member() -> IO[bytes]:
        # The member keeps the file open after the archive object is closed.
        with zipfile.ZipFile(path) as archive:
            return archive.open(member)

    return RawArray(
        name, open_member, offset=header.offset, dtype=header.dtype, shape=header.shape, forward_only=True
    )
