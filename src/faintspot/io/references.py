"""Reference positions from files: an array of positions, or the mean of measured slopes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.base.flags import leave_out
from faintspot.io.formats.registry import slope_endings, slope_format
from faintspot.io.frames import read_array
from faintspot.io.locations import split_location
from faintspot.io.slopes import read_slopes
from faintspot.io.stored.slopes_format import StoredSlopes


def read_reference(location: str | Path) -> NDArray[Any]:
    """Read reference positions for `SlopePipeline`.

    Parameters
    ----------
    location : str or Path
        File of slopes written by faintspot, e.g. of a flat wavefront, or an array as for `read_array`. Slopes
        give the mean of each sub-aperture's valid positions, including the reference that was subtracted. A
        sub-aperture without valid slopes takes the median displacement of the others: a source that is
        displaced as a whole is a tilt.

    Returns
    -------
    (n, 2) array
        x and y, px; an array is returned as stored, and may also be (2n,): all x, then all y.

    Raises
    ------
    InputError
        When the file is missing, damaged, of another format, or has no valid slopes.
    MissingExtraError
        When the package that reads the format is not installed.
    """
    path, key = split_location(location)
    if key is None and holds_slopes(path):
        return _mean_positions(path, read_slopes(path))
    return read_array(location)


def holds_slopes(path: Path) -> bool:
    """Return whether a path is a file of slopes written by faintspot, as far as its names say.

    Raises
    ------
    MissingExtraError
        When the package that reads the format is not installed.
    """
    if not path.name.lower().endswith(tuple(slope_endings())):
        return False
    form = slope_format(path)
    form.require()
    return form.has_slopes(path)


def _mean_positions(path: Path, slopes: StoredSlopes) -> NDArray[np.float64]:
    """Return the mean of the valid slopes of each sub-aperture, (n, 2), px from its centre."""
    valid = slopes.variables["valid"]
    count = np.count_nonzero(valid, axis=0)
    if not count.any():
        _, left_out = leave_out(slopes.variables["flags"])
        raise InputError(f"{path}: expected valid slopes to take as reference, found none ({left_out})")
    sums = [np.sum(slopes.variables[name], axis=0, where=valid, dtype=np.float64) for name in ("x", "y")]
    means: NDArray[np.float64] = np.stack(sums, axis=1) / np.maximum(count, 1)[:, np.newaxis]
    means[count == 0] = np.median(means[count > 0], axis=0)
    means += subtracted_reference(slopes)
    return means


def subtracted_reference(slopes: StoredSlopes) -> NDArray[np.float64]:
    """Return the reference that was subtracted from slopes, (n, 2), px from each sub-aperture's centre."""
    zero = np.zeros((slopes.variables["x"].shape[1], 2))
    reference: NDArray[np.float64] = np.asarray(slopes.attributes.get("reference", zero), np.float64)
    return reference.reshape(2, -1).T if reference.ndim == 1 else reference
