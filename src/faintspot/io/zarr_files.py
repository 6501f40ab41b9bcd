"""Arrays in Zarr stores (directories, format 2 or 3)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.errors import InputError, MissingExtraError
from faintspot.io.locations import StoredArray, choose_name, one_line

try:
    import zarr
except ImportError:
    raise MissingExtraError("zarr", "io", "Reading or writing a Zarr store") from None

__all__ = ["find_zarr", "is_store", "zarr"]

_MARKS = ("zarr.json", ".zgroup", ".zarray")


def is_store(path: Path) -> bool:
    """Tell whether a directory is a Zarr group or array."""
    return any((path / mark).is_file() for mark in _MARKS)


def find_zarr(path: Path, key: str | None) -> StoredArray:
    """Return one array of a Zarr store: the store itself, the one at path `key`, `frames` or the only one.

    Chunks that are absent from a store are its fill value by Zarr's definition, not an error.

    Raises
    ------
    InputError
        When the directory is no Zarr store, or there is no such array, or several and no key is given.
    MissingExtraError
        When zarr is not installed.
    """
    if not is_store(path):
        raise InputError(f"{path}: expected a Zarr store or a file of frames, this directory is neither")
    try:
        node: Any = zarr.open(str(path), mode="r", path=key or "")
        if isinstance(node, zarr.Group):
            arrays = dict(node.arrays())
            node = arrays[choose_name(path, {name: array.ndim for name, array in arrays.items()}, None)]
    except InputError:
        raise
    except Exception as error:  # broken metadata makes zarr raise many things
        where = f"{path}:{key}" if key else str(path)
        raise InputError(f"{where}: cannot be opened as a Zarr array ({one_line(error)})") from None
    return _ZarrArray(f"{path}:{node.path}" if node.path else str(path), node)


class _ZarrArray:
    def __init__(self, name: str, array: Any) -> None:
        self.name = name
        self.shape: tuple[int, ...] = tuple(array.shape)
        self.dtype: np.dtype[Any] = np.dtype(array.dtype).newbyteorder("=")
        self._array = array

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Return items `start` to `stop` of the first axis, in native byte order."""
        try:
            return np.asarray(self._array[start:stop]).astype(self.dtype, copy=False)
        except Exception as error:  # a broken chunk makes each codec raise its own kind
            raise InputError(
                f"{self.name}: frames {start} to {stop - 1} (counted from 0) cannot be read: "
                f"the store is damaged ({one_line(error)})"
            ) from None

    def close(self) -> None:
        """A store keeps nothing open."""
