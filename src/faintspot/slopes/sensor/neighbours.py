"""Neighbouring lenslets in square and hexagonal arrays."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

LEAST_DIFFERENCE = 0.1
"""Smaller differences between displacements of spots are treated as equal, in pitches."""

_BESIDE = ((0, 1), (0, -1), (1, 0), (-1, 0))
_DIAGONAL = ((1, -1), (-1, 1), (1, 1), (-1, -1))


def links_of(neighbours: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return pairs of neighbours (n, 2), each once, from the table that `neighbours_of` returns."""
    count = len(neighbours)
    pairs = np.column_stack([np.repeat(np.arange(count), neighbours.shape[1]), neighbours.ravel()])
    return np.asarray(pairs[(pairs[:, 0] < pairs[:, 1]) & (pairs[:, 1] < count)])


def neighbours_of(cells: NDArray[np.int64], geometry: str, *, diagonal: bool = False) -> NDArray[np.int64]:
    """Return the (n, 4 or 6) indices of the neighbours of each cell, n where there is none.

    With `diagonal` (n, 8), diagonal neighbours in square arrays are included.
    """
    steps = _BESIDE + _DIAGONAL[: 2 if geometry == "hexagonal" else 4 * diagonal]
    shifted = cells - cells.min(axis=0) + 1
    index = np.full(shifted.max(axis=0) + 2, len(cells), dtype=np.int64)
    index[shifted[:, 0], shifted[:, 1]] = np.arange(len(cells))
    return np.column_stack([index[shifted[:, 0] + row, shifted[:, 1] + column] for row, column in steps])


def as_rows(at: NDArray[np.complex128]) -> NDArray[np.float64]:
    """Return complex positions as rows of x, y."""
    return np.column_stack([at.real, at.imag])


def as_tree(at: NDArray[np.complex128]) -> cKDTree:
    """Return a tree of complex positions, in which near ones are found."""
    return cKDTree(as_rows(at))
