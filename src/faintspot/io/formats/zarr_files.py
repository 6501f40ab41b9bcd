"""Zarr stores (directories): frames in format 2 or 3, slopes in format 3."""

from __future__ import annotations

import math
import os
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.io.arrays.zarr_store import check_array, is_store, open_store
from faintspot.io.formats.file_format import FileFormat
from faintspot.io.locations import StoredArray, choose_name, one_line
from faintspot.io.optional_packages import load_zarr
from faintspot.io.stored.slopes_format import RecordingHeader, StoredSlopes
from faintspot.io.stored.slopes_writer import ExistingOutput, Storage

_MOST_ABSENT = 1000  # missing chunks per existing chunk


class Zarr(FileFormat):
    """Frames in an array of a store; slopes in a store that can be read while it is written."""

    name = "Zarr"
    endings = (".zarr",)

    def has_frames(self, path: Path, start: bytes) -> bool:
        """Return whether the path is a folder."""
        return not start

    def find(self, path: Path, key: str | None) -> StoredArray:
        """Return the array at path `key`, the store itself, its array `frames`, or its only array.

        By Zarr's definition, missing chunks hold the fill value; that is not an error.
        """
        if not is_store(path):
            raise InputError(f"{path}: expected a Zarr store or a file of frames, this directory is neither")
        zarr = load_zarr()
        try:
            node: Any = open_store(path, key or "")
            if isinstance(node, zarr.Group):
                arrays = dict(node.arrays())
                node = arrays[choose_name(path, {name: array.ndim for name, array in arrays.items()}, None)]
        except InputError:
            raise
        except Exception as error:  # zarr raises many kinds of errors on broken metadata
            where = f"{path}:{key}" if key else str(path)
            raise InputError(f"{where}: cannot be opened as a Zarr array ({one_line(error)})") from None
        name = f"{path}:{node.path}" if node.path else str(path)
        check_array(name, node)
        _check_presence(path, name, node)
        return _ZarrArray(name, node)

    def require(self) -> None:
        """Raise MissingExtraError when zarr is not installed."""
        load_zarr()

    def read(self, path: Path) -> StoredSlopes:
        """Read the finished frames of a store."""
        load_zarr()
        from faintspot.io.stored.slopes_zarr import read_store

        return read_store(path)

    def has_slopes(self, path: Path) -> bool:
        """Return whether the store's attributes are those of slopes."""
        from faintspot.io.stored.slopes_zarr import describe_store

        try:
            return describe_store(path) is not None
        except InputError:
            return False

    def finished(self, path: Path) -> ExistingOutput | None:
        """Return the description of a complete store."""
        from faintspot.io.stored.slopes_zarr import describe_store

        begun = describe_store(path)
        return begun if begun is not None and begun.complete else None

    def leftovers(self, path: Path) -> bool:
        """Return False: there are no files beside a store."""
        return False

    def storage(self, path: Path, run: RecordingHeader) -> Storage:
        """Return the store itself, which grows."""
        from faintspot.io.stored.slopes_zarr import StoreStorage

        return StoreStorage(path, run)


def _check_presence(path: Path, name: str, array: Any) -> None:
    """Refuse an array with hardly any chunk present: reading its fill values would take for ever."""
    parts = array.shards or array.chunks
    promised = math.prod(-(-side // part) for side, part in zip(array.shape, parts, strict=True))
    if promised <= _MOST_ABSENT:
        return
    folder = path / array.path
    files = (file for _, _, files in os.walk(folder) for file in files if not file.endswith(".json"))
    present = sum(1 for _ in islice(files, promised // _MOST_ABSENT + 1))
    if present * _MOST_ABSENT < promised:
        raise InputError(f"{name}: expected the {promised:,} chunks that it states, found {present:,}")


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
        except Exception as error:  # each codec raises its own kind of error on broken chunks
            raise InputError(
                f"{self.name}: frames {start} to {stop - 1} (counted from 0) cannot be read: "
                f"the store is damaged ({one_line(error)})"
            ) from None

    def close(self) -> None:
        """Do nothing: a store keeps no file open."""
