"""Frames in HDF5 files, and in those of MATLAB, of version 7.3 and before."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.io.arrays.inflation import check_inflated, is_surely_small
from faintspot.io.arrays.stored_array import StoredArray
from faintspot.io.formats.file_format import FileFormat
from faintspot.io.locations import choose_name
from faintspot.io.optional_packages import load_hdf5

_KEEPING_SIZE = (2, 3)  # shuffle, Fletcher's checksum
_CODECS = {
    1: "deflate",
    4: "szip",
    307: "bz2",
    32001: "blosc",
    32004: "hdf5-lz4",
    32008: "hdf5-lz4",
    32015: "zstd",
}
"""Compressing filters by number; of others (lzf), no chunk inflates to more than a hundred times its size."""


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
            name, shape, chunks = f"{path}:{chosen}", data_set.shape, data_set.chunks
            compressions = _check(name, data_set)
            reverse = self.matlab and len(shape) > 1
            if reverse:  # MATLAB's (height, width, frames) is (frames, width, height) here
                shape, chunks = (sides and (*sides[:-2], *sides[:-3:-1]) for sides in (shape, chunks))

            def open_array(files: ExitStack) -> object:
                data_set = files.enter_context(h5py.File(path, "r"))[chosen]
                return _DataSet(name, data_set, reverse)

            options: dict[str, Any] = {"matlab": self.matlab, "chunks": chunks, "compressions": compressions}
            return StoredArray(name, shape, data_set.dtype, open_array, **options)


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


def _check(name: str, data_set: Any) -> int:
    """Refuse data in other files and Python objects; return how often chunks are compressed."""
    if data_set.is_virtual or data_set.external:
        raise InputError(f"{name}: expected data in this file, they are stored in other files")
    if data_set.dtype.hasobject:
        raise InputError(f"{name}: expected numbers, got {data_set.dtype}")
    return sum(code not in _KEEPING_SIZE for code in _filters(data_set))


def _filters(data_set: Any) -> list[int]:
    """Return the numbers of the filters of the chunks, in the order in which they were applied."""
    filters = data_set.id.get_create_plist()
    return [int(filters.get_filter(number)[0]) for number in range(filters.get_nfilters())]


class _DataSet:
    """A data set, or one whose last two axes are exchanged, whose chunks are checked before they are read."""

    def __init__(self, name: str, data_set: Any, reverse: bool) -> None:
        self._name, self._data_set, self._reverse = name, data_set, reverse
        self._large: set[tuple[int, ...]] = set()  # chunks that may inflate to more than the limit
        filters = enumerate(_filters(data_set))
        known = ((place, _CODECS[code]) for place, code in filters if code in _CODECS)
        self._place, self._codec = next(known, (0, ""))
        if self._codec and not is_surely_small(data_set.id.get_storage_size(), self._codec):
            data_set.id.chunk_iter(self._note)

    def _note(self, chunk: Any) -> None:
        if not (is_surely_small(chunk.size, self._codec) or chunk.filter_mask >> self._place & 1):
            self._large.add(chunk.chunk_offset)

    def __getitem__(self, part: Any) -> NDArray[Any]:
        """Return items of the first axis, or of a later one after numbers of the items of the first."""
        across = self._reverse and self._data_set.ndim == 2
        selection = (slice(None), part) if across else part if isinstance(part, tuple) else (part,)
        for first in self._large and self._chunks_of(selection):
            check_inflated(self._name, self._data_set.id.read_direct_chunk(first)[1], self._codec)
            self._large.remove(first)
        values = np.asarray(self._data_set[selection])
        return values.swapaxes(-1, -2) if self._reverse else values

    def _chunks_of(self, selection: tuple[Any, ...]) -> list[tuple[int, ...]]:
        """Return the large chunks that overlap a selection."""
        spans = [
            range(side)[item] if isinstance(item, slice) else range(item, item + 1)
            for item, side in zip(selection, self._data_set.shape, strict=False)
        ]
        return [
            first
            for first in self._large
            if all(
                at < span.stop and span.start < at + side
                for at, side, span in zip(first, self._data_set.chunks, spans, strict=False)
            )
        ]


_TYPES = {"double": "f8", "single": "f4", "logical": "u1"} | {
    f"{sign}int{8 * size}": f"{sign or 'i'}{size}" for sign in ("", "u") for size in (1, 2, 4, 8)
}


class Matlab(FileFormat):
    """Frames in a variable (height, width, frames), which is read whole."""

    name = "MATLAB"
    signatures = (b"MATLAB 5",)

    def find(self, path: Path, key: str | None) -> StoredArray:
        """Return the variable `key`, the one named `frames`, or the only one of 2 or 3 dimensions."""
        import scipy.io  # slow import: a tenth of a second

        variables = {name: (shape, kind) for name, shape, kind in scipy.io.whosmat(path)}
        dimensions = {
            name: len(shape) if max(shape, default=0) > 1 else 0  # MATLAB stores numbers as 1 x 1 arrays
            for name, (shape, kind) in variables.items()
            if kind in _TYPES
        }
        chosen = choose_name(path, dimensions, key)
        shape, kind = variables[chosen]

        def load() -> NDArray[Any]:
            values = scipy.io.loadmat(path, variable_names=[chosen], mat_dtype=True)[chosen]
            return np.asarray(np.moveaxis(values, -1, 0) if values.ndim > 2 else values)

        frames_first = (*shape[2:], *shape[:2]) if len(shape) < 4 else (shape[-1], *shape[:-1])
        return StoredArray.whole(f"{path}:{chosen}", frames_first, np.dtype(_TYPES[kind]), load, matlab=True)
