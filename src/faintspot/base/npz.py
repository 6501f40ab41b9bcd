"""NumPy's .npz files: written atomically, and read within a size limit that is checked first."""

from __future__ import annotations

import lzma
import math
import zipfile
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, ClassVar, Self

import numpy as np

from faintspot.base.errors import InputError
from faintspot.base.files import check_regular, write_atomically
from faintspot.base.sizes import check_bytes

MOST_BYTES = 1 << 29
"""Maximum total memory of the arrays of a file."""
DAMAGE = (
    OSError,
    EOFError,
    zlib.error,
    lzma.LZMAError,
    zipfile.BadZipFile,
    RuntimeError,
    NotImplementedError,
)
"""Exceptions of the gzip and zip decoders."""


@dataclass(frozen=True)
class Header:
    """Header of a .npy file, or of a member of a .npz file."""

    shape: tuple[int, ...]
    fortran_order: bool
    dtype: np.dtype[Any]
    offset: int

    @property
    def data_bytes(self) -> int:
        """Size of the array in bytes."""
        return math.prod(self.shape) * self.dtype.itemsize


def read_header(name: str, stream: IO[bytes], actual_bytes: int) -> Header:
    """Read the header of an array whose file has `actual_bytes` bytes including the header.

    Raises
    ------
    InputError
        If it is invalid, describes Python objects, or the array is truncated.
    """
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    try:
        version = np.lib.format.read_magic(stream)
        shape, fortran_order, dtype = readers[version](stream)
    except KeyError:
        raise InputError(f"{name}: expected .npy format version 1 or 2, got another") from None
    except DAMAGE:
        raise
    except Exception as error:  # NumPy evaluates the header as Python, which can fail in many ways
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{name}: expected a NumPy array ({reason})") from None
    header = Header(shape, fortran_order, dtype, stream.tell())
    if dtype.hasobject:
        raise InputError(f"{name}: expected numbers, got Python objects, which are never unpickled")
    if any(side < 0 for side in shape):
        raise InputError(f"{name}: damaged: its header has the shape {shape}")
    if actual_bytes < (promised := header.offset + header.data_bytes):
        raise InputError(f"{name}: truncated: its header promises {promised} bytes, there are {actual_bytes}")
    return header


def open_archive(path: str | Path) -> tuple[zipfile.ZipFile, dict[str, zipfile.ZipInfo]]:
    """Open a .npz file; return it, and its members by array name.

    Raises
    ------
    InputError
        If it is not a regular file.
    Exception
        Any of `DAMAGE`.
    """
    check_regular(path)
    archive = zipfile.ZipFile(path)
    items = [item for item in archive.infolist() if item.filename.endswith(".npy")]
    return archive, {item.filename.removesuffix(".npy"): item for item in items}


def headers_of(path: str | Path, names: Iterable[str] | None = None) -> dict[str, Header]:
    """Return the headers of the named arrays that exist, or of all; errors are those of `open_archive`."""
    archive, members = open_archive(path)
    with archive:
        headers = {}
        for name in members if names is None else (name for name in names if name in members):
            with archive.open(members[name]) as stream:
                headers[name] = read_header(f"{path}:{name}", stream, members[name].file_size)
    return headers


def unpacked(
    path: str | Path, what: str, names: Iterable[str] | None = None, most: int = MOST_BYTES
) -> dict[str, Any]:
    """Return the named arrays that exist, or all, if they need at most `most` bytes.

    Raises
    ------
    InputError
        If they need more.
    Exception
        As for `open_archive`; ValueError if an array is damaged.
    """
    headers = headers_of(path, names)
    check_bytes(path, sum(header.data_bytes for header in headers.values()), most, what)
    archive, members = open_archive(path)
    values = {}
    with archive:
        for name in headers:
            # zip returns no more bytes than the member states, whatever its data inflate to.
            with archive.open(members[name]) as stream:
                values[name] = np.lib.format.read_array(stream, allow_pickle=False)
    return values


def save_arrays(path: str | Path, arrays: Mapping[str, Any]) -> None:
    """Write arrays to a compressed file atomically, with `write_atomically`.

    Raises
    ------
    InputError
        If it cannot be written.
    """
    write_atomically(path, lambda stream: np.savez_compressed(stream, **arrays))


def read_arrays(
    path: str | Path,
    what: str,
    names: Sequence[str] | None = None,
    optional: Sequence[str] = (),
    most: int = MOST_BYTES,
) -> dict[str, Any]:
    """Read the named arrays, or all, from a file that should contain `what` in at most `most` bytes.

    Raises
    ------
    InputError
        If it cannot be read, is too large, or a required array is missing.
    """
    try:
        values = unpacked(path, what, names, most)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except InputError:
        raise
    except Exception:  # a damaged archive can raise any error of its decoder
        raise InputError(f"{path}: expected {what} (.npz), got something else") from None
    for name in names or ():
        if name not in values and name not in optional:
            raise InputError(f"{path}: expected {what}, but {name} is missing")
    return values


class NpzFile:
    """Object with arrays and numbers that are its constructor's arguments, saved in an .npz file."""

    WHAT: ClassVar[str]
    """Kind of file, named in errors."""
    FIELDS: ClassVar[tuple[str, ...]]
    """Names of the values in a file."""
    OPTIONAL: ClassVar[tuple[str, ...]] = ("index",)
    """Names of those that may be None."""

    def save(self, path: str | Path) -> None:
        """Write the values to a file (.npz).

        Raises
        ------
        InputError
            If the file cannot be written.
        """
        values = {name: getattr(self, name) for name in self.FIELDS}
        save_arrays(path, {name: value for name, value in values.items() if value is not None})

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a file written by `save`.

        Raises
        ------
        InputError
            If the file cannot be read or holds something else.
        """
        values = read_arrays(path, cls.WHAT, cls.FIELDS, cls.OPTIONAL)
        try:
            return cls(**{name: value if value.ndim else value.item() for name, value in values.items()})
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
