"""Reference positions from files: an array of positions, or the mean of measured slopes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.io.formats import slope_endings, slope_format
from faintspot.io.frames import read_array
from faintspot.io.locations import split_location
from faintspot.io.slopes import read_slopes
from faintspot.io.slopes_format import StoredSlopes


def read_reference(location: str | Path) -> NDArray[Any]:
    """Read reference positions as `SlopePipeline` takes them.

    Parameters
    ----------
    location : str or Path
        A file of slopes that faintspot has written, of a flat wavefront for example: the mean of each
        sub-aperture's valid slopes, on top of the reference that they were measured with. Where none is
        valid, that reference, or else the sub-aperture's centre. Or an array, as for `read_array`.

    Returns
    -------
    (n, 2) array
        x and y, px; an array as it is stored, which may be (2n,), too: all x, then all y.

    Raises
    ------
    InputError
        When the file is missing, damaged, of another format, or has no valid slope at all.
    MissingExtraError
        When the package that reads the format is not installed.
    """
    path, key = split_location(location)
    if key is None and path.name.lower().endswith(tuple(slope_endings())):
        form = slope_format(path)
        form.require()
        if form.has_slopes(path):
            return _mean_positions(path, read_slopes(path))
    return read_array(location)


def _mean_positions(path: Path, slopes: StoredSlopes) -> NDArray[np.float64]:
    """Return the mean of the valid slopes of each sub-aperture, (n, 2), px from its centre."""
    valid = slopes.variables["valid"]
    count = np.count_nonzero(valid, axis=0)
    if not count.any():
        raise InputError(f"{path}: expected slopes to take as reference, found none that is valid")
    sums = [np.sum(slopes.variables[name], axis=0, where=valid, dtype=np.float64) for name in ("x", "y")]
    means: NDArray[np.float64] = np.stack(sums, axis=1) / np.maximum(count, 1)[:, np.newaxis]
    before: NDArray[np.float64] = np.asarray(
        slopes.attributes.get("reference", np.zeros_like(means)), np.float64
    )
    if before.ndim == 1:
        before = before.reshape(2, -1).T
    means += before
    return means
