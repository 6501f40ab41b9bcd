"""Frames in MATLAB files of version 5 (also called 6 and 7), read by SciPy; 7.3 is in `hdf5_files`."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.io.arrays.inflation import check_inflated
from faintspot.io.arrays.raw import MOST_WHOLE_BYTES, WholeArray
from faintspot.io.formats.file_format import FileFormat
from faintspot.io.locations import StoredArray, choose_name, one_line

_TYPES = {"double": "f8", "single": "f4", "logical": "u1"} | {
    f"{sign}int{8 * size}": f"{sign or 'i'}{size}" for sign in ("", "u") for size in (1, 2, 4, 8)
}
_HEADER_BYTES, _COMPRESSED = 128, 15


class Matlab(FileFormat):
    """Frames in a variable (height, width, frames), which is read whole."""

    name = "MATLAB"
    signatures = (b"MATLAB 5",)

    def find(self, path: Path, key: str | None) -> StoredArray:
        """Return the variable `key`, the one named `frames`, or the only one of 2 or 3 dimensions."""
        import scipy.io  # slow import: a tenth of a second

        _check_elements(path)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                stored = {name: (shape, kind) for name, shape, kind in scipy.io.whosmat(path)}
        except Exception as error:  # SciPy raises many kinds of errors on damaged files
            raise InputError(f"{path}: expected a whole MATLAB file ({one_line(error)})") from None
        dimensions = {
            name: len(shape) if max(shape, default=0) > 1 else 0  # MATLAB stores numbers as 1 x 1 arrays
            for name, (shape, kind) in stored.items()
            if kind in _TYPES
        }
        chosen = choose_name(path, dimensions, key)
        shape, kind = stored[chosen]

        def load() -> NDArray[Any]:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                values = scipy.io.loadmat(path, variable_names=[chosen], mat_dtype=True)[chosen]
            return np.asarray(np.moveaxis(values, -1, 0) if values.ndim == 3 else values)

        ordered = (*shape[2:], *shape[:2])
        return WholeArray(f"{path}:{chosen}", ordered, np.dtype(_TYPES[kind]), load)


def _check_elements(path: Path) -> None:
    """Refuse a file with an element that inflates to more than may be read whole."""
    with path.open("rb") as stream:
        order = "<" if stream.read(_HEADER_BYTES)[-2:] == b"IM" else ">"
        while len(tag := stream.read(8)) == 8:
            kind, n_bytes = np.frombuffer(tag, f"{order}u4").tolist()
            start = stream.tell()
            if kind == _COMPRESSED:
                check_inflated(str(path), stream.read(min(n_bytes, MOST_WHOLE_BYTES)))
            stream.seek(start + n_bytes)
