"""Neighbouring lenslets in square and hexagonal arrays."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

LEAST_DIFFERENCE = 0.1
"""Smaller differences between displacements of spots are treated as equal, in pitches."""

_BESIDE = ((0, 1), (0, -1), (1, 0), (-1, 0))
_DIAGONAL = ((1, -1), (-1, 1), (1, 1), (-1, -1))


def neighbours_of(cells: NDArray[np.int64], geometry: str, *, diagonal: bool = False) -> NDArray[np.int64]:
    """Return the (n, 4 or 6) indices of the neighbours of each cell, n where there is none.

    With `diagonal` (n, 8), diagonal neighbours in square arrays are included.
    """
    steps = _BESIDE + _DIAGONAL[: 2 if geometry == "hexagonal" else 4 * diagonal]
    shifted = cells - cells.min(axis=0) + 1
    index = np.full(shifted.max(axis=0) + 2, len(cells), dtype=np.int64)
    index[shifted[:, 0], shifted[:, 1]] = np.arange(len(cells))
    return np.column_stack([index[shifted[:, 0] + row, shifted[:, 1] + column] for row, column in steps])
