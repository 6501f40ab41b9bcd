"""Measured Strehl ratios of a night, from a CSV file with the time of each exposure."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.io.frames import read_array

Floats = NDArray[np.float64]

_COLUMNS = (2, 3)


@dataclass(frozen=True, eq=False)
class MeasuredStrehl:
    """Strehl ratios of exposures, in the order of time."""

    time_s: Floats
    """Unix time of the middle of each exposure."""
    strehl: Floats
    exposure_s: Floats

    def of_interval(self, begin_s: float, end_s: float) -> Floats:
        """Return the Strehl ratios of the exposures that lie within an interval of Unix time."""
        first, last = np.searchsorted(self.time_s, [begin_s, end_s])
        near = slice(int(first), int(last))
        half = self.exposure_s[near] / 2
        within = (self.time_s[near] - half >= begin_s) & (self.time_s[near] + half <= end_s)
        return np.asarray(self.strehl[near][within])


def read_strehl(path: str | Path) -> MeasuredStrehl:
    """Read a table: Unix time of the middle [s], Strehl ratio, and perhaps the duration [s] of exposures.

    A first line of names is skipped.

    Raises
    ------
    InputError
        When the file cannot be read, or values are missing or out of range.
    """
    table = read_array(path).astype(np.float64)
    if table.ndim != 2 or table.shape[1] not in _COLUMNS:
        raise InputError(
            f"{path}: expected the columns time_s, strehl and perhaps exposure_s, got shape {table.shape}"
        )
    wrong = np.flatnonzero(~np.isfinite(table).all(axis=1) | (table[:, 1] < 0) | (table[:, 1] > 1))
    if len(wrong):
        raise InputError(
            f"{path}: expected finite times and Strehl ratios from 0 to 1, got "
            f"{', '.join(f'{value:g}' for value in table[wrong[0]])}"
        )
    table = table[np.argsort(table[:, 0], kind="stable")]
    exposure_s = table[:, 2] if table.shape[1] == _COLUMNS[1] else np.zeros(len(table))
    if (exposure_s < 0).any():
        raise InputError(f"{path}: exposure_s: expected 0 or more, got {exposure_s.min():g}")
    return MeasuredStrehl(table[:, 0], table[:, 1], exposure_s)
