"""Frames in HDF5 files, including those of MATLAB's version 7.3."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.base.sizes import check_bytes
from faintspot.io.arrays.inflation import check_inflated
from faintspot.io.arrays.raw import MOST_WHOLE_BYTES
from faintspot.io.formats.file_format import FileFormat
from faintspot.io.locations import StoredArray, choose_name, one_line
from faintspot.io.optional_packages import load_hdf5

_MOST_OBJECTS = 10_000


class Hdf5(FileFormat):
    """Frames in a data set, selected by its path in the file."""

    name = "HDF5"
    signatures: tuple[bytes, ...] = (b"\x89HDF\r\n\x1a\n",)
    matlab = False

    def find(self, path: Path, key: str | None) -> StoredArray:
        """Return the data set at `key`, the one named `frames`, or the only one of 2 or 3 dimensions."""
        h5py = load_hdf5()
        try:
            with h5py.File(path, "r") as file:
                found = _data_sets(h5py, file)
                chosen = choose_name(path, found, None if key is None else key.strip("/"))
                return _DataSet(path, chosen, file[chosen], reverse=self.matlab)
        except InputError:
            raise
        except Exception as error:  # h5py raises many kinds of errors on damaged files
            raise InputError(f"{path}: expected a whole {self.name} file ({one_line(error)})") from None


class Matlab73(Hdf5):
    """Variables of a MATLAB file; HDF5 stores their axes in reverse order: (height, width, frames)."""

    name = "MATLAB"
    signatures = (b"MATLAB 7",)
    matlab = True


def _data_sets(h5py: Any, file: Any) -> dict[str, int]:
    """Return the number of dimensions of each data set by its path; links are not followed."""
    found: dict[str, int] = {}
    seen = 0

    def visit(name: str, item: Any) -> bool | None:
        nonlocal seen
        seen += 1
        if isinstance(item, h5py.Dataset) and not name.startswith("#"):  # MATLAB's internal data
            found[name] = len(item.shape or ())
        return True if seen >= _MOST_OBJECTS else None

    file.visititems(visit)
    return found


class _DataSet:
    """A data set that is read in parts; the file is reopened for the first of them."""

    def __init__(self, path: Path, key: str, item: Any, *, reverse: bool) -> None:
        self.name = f"{path}:{key}"
        self.dtype: np.dtype[Any] = item.dtype.newbyteorder("=")
        self._path, self._key = path, key
        self._reverse = reverse
        shape = tuple(int(side) for side in item.shape)
        if reverse:  # MATLAB's (height, width, frames) is (frames, width, height) here
            shape = (*shape[:-2], *shape[:-3:-1])
        self.shape: tuple[int, ...] = shape
        self._file: Any = None
        if item.is_virtual or item.external:
            raise InputError(f"{self.name}: expected data in this file, they are stored in other files")
        if item.dtype.hasobject:
            raise InputError(f"{self.name}: expected numbers, got {item.dtype}")
        if item.chunks is not None:
            n_bytes = int(np.prod(item.chunks, dtype=object)) * item.dtype.itemsize
            check_bytes(self.name, n_bytes, MOST_WHOLE_BYTES, "a chunk")

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Return items `start` to `stop` of the first axis, in native byte order."""
        part = [slice(0, side) for side in self.shape]
        part[0] = slice(start, stop)
        if self._reverse:
            part[-2:] = part[:-3:-1]
        try:
            if self._file is None:
                self._file = load_hdf5().File(self._path, "r")
            item = self._file[self._key]
            self._check_chunks(item, part)
            values = np.asarray(item[tuple(part)])
        except InputError:
            raise
        except Exception as error:  # each filter raises its own kind of error
            self.close()
            raise InputError(
                f"{self.name}: frames {start} to {stop - 1} (counted from 0) cannot be read: "
                f"the file is damaged ({one_line(error)})"
            ) from None
        if self._reverse and values.ndim > 1:
            values = values.swapaxes(-1, -2)
        return np.ascontiguousarray(values, self.dtype)

    def close(self) -> None:
        """Close the file; a later `read` opens it again."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def _check_chunks(self, item: Any, part: list[slice]) -> None:
        """Refuse chunks of this part that inflate to more than twice their stated size."""
        if item.chunks is None or item.compression is None:
            return
        most = 2 * int(np.prod(item.chunks)) * item.dtype.itemsize
        sides = zip(part, item.chunks, strict=True)
        for place in itertools.product(*(range(s.start // n * n, s.stop, n) for s, n in sides)):
            if item.id.get_chunk_info_by_coord(place).byte_offset is not None:
                check_inflated(self.name, item.id.read_direct_chunk(place)[1], most)
