"""Frames in HDF5 files, including those of MATLAB's version 7.3."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.base.sizes import check_bytes
from faintspot.io.arrays.stored_array import MOST_WHOLE_BYTES, StoredArray
from faintspot.io.formats.file_format import FileFormat
from faintspot.io.locations import choose_name
from faintspot.io.optional_packages import load_hdf5


class Hdf5(FileFormat):
    """Frames in a data set, selected by its path in the file."""

    name = "HDF5"
    signatures: tuple[bytes, ...] = (b"\x89HDF\r\n\x1a\n",)
    matlab = False

    def find(self, path: Path, key: str | None) -> StoredArray:
        """Return the data set at `key`, the one named `frames`, or the only one of 2 or 3 dimensions."""
        h5py = load_hdf5()
        with h5py.File(path, "r") as file:
            chosen = choose_name(path, _dimensions(h5py, file), None if key is None else key.strip("/"))
            data_set = file[chosen]
            name, shape = f"{path}:{chosen}", data_set.shape
            _check(name, data_set)
            reverse = self.matlab and len(shape) > 1
            if reverse:  # MATLAB's (height, width, frames) is (frames, width, height) here
                shape = (*shape[:-2], *shape[:-3:-1])

            def open_array(files: ExitStack) -> object:
                data_set = files.enter_context(h5py.File(path, "r"))[chosen]
                return _Transposed(data_set) if reverse else data_set

            return StoredArray(name, shape, data_set.dtype, open_array, matlab=self.matlab)


class Matlab73(Hdf5):
    """Variables of a MATLAB file; HDF5 stores their axes in reverse order: (height, width, frames)."""

    name = "MATLAB"
    signatures = (b"MATLAB 7",)
    matlab = True


def _dimensions(h5py: Any, file: Any) -> dict[str, int]:
    """Return the number of dimensions of each data set by its path; links are not followed."""
    dimensions: dict[str, int] = {}

    def visit(name: str, item: object) -> None:
        if isinstance(item, h5py.Dataset) and not name.startswith("#"):  # MATLAB's internal data
            dimensions[name] = len(item.shape or ())

    file.visititems(visit)
    return dimensions


def _check(name: str, data_set: Any) -> None:
    """Refuse data in other files, Python objects and chunks that are too large."""
    if data_set.is_virtual or data_set.external:
        raise InputError(f"{name}: expected data in this file, they are stored in other files")
    if data_set.dtype.hasobject:
        raise InputError(f"{name}: expected numbers, got {data_set.dtype}")
    if data_set.chunks is not None:
        n_bytes = int(np.prod(data_set.chunks, dtype=object)) * data_set.dtype.itemsize
        check_bytes(name, n_bytes, MOST_WHOLE_BYTES, "a chunk")


class _Transposed:
    """A data set whose last two axes are exchanged."""

    def __init__(self, data_set: Any) -> None:
        self._data_set = data_set

    def __getitem__(self, part: slice) -> NDArray[Any]:
        """Return items of the first axis."""
        values = self._data_set[:, part] if self._data_set.ndim == 2 else self._data_set[part]
        return np.asarray(values).swapaxes(-1, -2)
