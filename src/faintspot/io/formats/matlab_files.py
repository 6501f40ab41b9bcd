"""Frames in MATLAB files of version 5 (also called 6 and 7), read by SciPy; 7.3 is in `hdf5_files`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.io.arrays.stored_array import StoredArray
from faintspot.io.formats.file_format import FileFormat
from faintspot.io.locations import choose_name

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
