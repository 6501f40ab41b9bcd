"""Zarr stores (directories): frames in format 2 or 3, slopes in format 3."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from faintspot.base.errors import InputError, load_zarr
from faintspot.io.formats.file_format import FileFormat
from faintspot.io.slopes_format import ExistingOutput, StoredSlopes
from faintspot.io.slopes_zarr import describe_store, read_store
from faintspot.io.stored_array import StoredArray, choose_name
from faintspot.io.zarr_store import CheckedChunks, check_array, is_store, open_store


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
        node: Any = open_store(path, key or "")
        if isinstance(node, zarr.Group):
            arrays = dict(node.arrays())
            node = arrays[choose_name(path, {name: array.ndim for name, array in arrays.items()}, None)]
        name = f"{path}:{node.path}" if node.path else str(path)
        options: dict[str, Any] = {"chunks": node.chunks, "compressions": check_array(name, node)}
        chunks = CheckedChunks(name, path / node.path, node)
        return StoredArray(name, node.shape, np.dtype(node.dtype), lambda _: chunks, **options)

    def require(self) -> None:
        """Raise MissingExtraError when zarr is not installed."""
        load_zarr()

    def read(self, path: Path) -> StoredSlopes:
        """Read the finished frames of a store."""
        return read_store(path)

    def has_slopes(self, path: Path) -> bool:
        """Return whether the store's attributes are those of slopes."""
        try:
            return describe_store(path) is not None
        except InputError:
            return False

    def finished(self, path: Path) -> ExistingOutput | None:
        """Return the description of a complete store."""
        store = describe_store(path)
        return store if store is not None and store.complete else None

    def store(self, path: Path) -> Path:
        """Return the output itself, which grows."""
        return path
