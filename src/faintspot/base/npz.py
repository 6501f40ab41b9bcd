"""NumPy's .npz files: written atomically, and read within a size limit that is checked first."""

from __future__ import annotations

import zipfile
from collections.abc import Collection, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np

from faintspot.base.errors import InputError, errors_within
from faintspot.base.files import check_regular, write_atomically
from faintspot.base.sizes import check_bytes

MOST_BYTES = 1 << 29
"""Maximum total memory of the arrays of a file."""


def unpacked(
    path: str | Path, what: str, names: Collection[str] | None = None, most: int = MOST_BYTES
) -> dict[str, Any]:
    """Return the named arrays that exist, or all, if they need at most `most` bytes.

    Raises
    ------
    InputError
        If they need more, or the path is not a regular file.
    Exception
        If the file is damaged, or no .npz file.
    """
    check_regular(path)
    with Path(path).open("rb") as stream:
        if not zipfile.is_zipfile(stream):  # np.load would read a .npy file whole
            raise zipfile.BadZipFile("not a zip file")
        stream.seek(0)
        archive = np.load(stream, allow_pickle=False)
        members = [item for item in archive.zip.infolist() if item.filename.endswith(".npy")]
        n_bytes = {item.filename.removesuffix(".npy"): item.file_size for item in members}
        chosen = [name for name in n_bytes if names is None or name in names]
        check_bytes(path, sum(n_bytes[name] for name in chosen), most, what)
        return {name: archive[name] for name in chosen}


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
    """Object with arrays, texts and numbers that are its constructor's arguments, saved in an .npz file."""

    WHAT: ClassVar[str]
    """Kind of file, named in errors."""
    FIELDS: ClassVar[tuple[str, ...]] = ()
    """Names of the values in a file. Default: the fields of a dataclass."""
    OPTIONAL: ClassVar[tuple[str, ...]] = ("index",)
    """Names of those that may be None."""
    FORMAT: ClassVar[int | None] = None
    """Number that a change of the fields changes: files of another one are refused. None: files have none."""

    def save(self, path: str | Path) -> None:
        """Write the values to a compressed file (.npz), which is never seen half written.

        Raises
        ------
        InputError
            If the file cannot be written.
        """
        values = {"format": self.FORMAT, **{name: getattr(self, name) for name in self._names()}}
        save_arrays(path, {name: value for name, value in values.items() if value is not None})

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a file written by `save`.

        Raises
        ------
        InputError
            If the file cannot be read or holds something else.
        """
        values = read_arrays(path, cls.WHAT, cls._names() if cls.FORMAT is None else None, cls.OPTIONAL)
        version = values.pop("format", None)
        if cls.FORMAT is not None and (version != cls.FORMAT or set(values) != set(cls._names())):
            raise InputError(f"{path}: expected {cls.WHAT} of format {cls.FORMAT}, got something else")
        with errors_within(path):
            return cls(**{name: _restored(value) for name, value in values.items()})

    @classmethod
    def _names(cls) -> tuple[str, ...]:
        return cls.FIELDS or tuple(item.name for item in fields(cls))  # type: ignore[arg-type]


def _restored(value: Any) -> object:
    """Return an array as what it was: a row of texts is a tuple, what has no axes a plain number or text."""
    if value.ndim == 0:
        return value.item()
    return tuple(value.tolist()) if value.dtype.kind == "U" and value.ndim == 1 else value
