"""Regions of a frame given by the user, pupil and rectangle, and neighbours of sub-apertures."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import EllipsisType

import numpy as np
import scipy
from numpy.typing import NDArray

from faintspot.base.checks import numbers_between
from faintspot.base.errors import InputError


@dataclass(frozen=True)
class PupilRegion:
    """Disk or annulus on the detector: centre x + 1j * y, outer and inner radius [px]."""

    centre: complex
    radius: float
    inner: float

    @classmethod
    def given(cls, value: object) -> PupilRegion:
        """Return the region (x, y, radius) or (x, y, radius, inner radius); raise InputError if invalid."""
        numbers = numbers_between("pupil", value)
        if numbers.ndim != 1 or len(numbers) not in (3, 4):
            raise InputError("pupil: expected x, y, radius and, for an annulus, the inner radius, in pixels")
        x, y, radius, inner = (float(number) for number in np.append(numbers, 0.0)[:4])
        if not radius > inner >= 0:
            raise InputError(f"pupil: expected radius > inner radius >= 0, got {radius:g} and {inner:g}")
        return cls(complex(x, y), radius, inner)

    def moved(self, step: complex) -> PupilRegion:
        """Return the region moved by x + 1j * y."""
        return replace(self, centre=self.centre + step)

    def holds(self, at: NDArray[np.complex128]) -> NDArray[np.bool_]:
        """Return which positions x + 1j * y are inside."""
        distance = np.abs(at - self.centre)
        return np.asarray((distance <= self.radius) & (distance >= self.inner))


@dataclass(frozen=True)
class Rectangle:
    """Columns x0 to x1 - 1 and rows y0 to y1 - 1 of a frame."""

    x0: int
    y0: int
    x1: int
    y1: int

    @classmethod
    def given(cls, value: object, shape: tuple[int, ...]) -> Rectangle:
        """Return the rectangle (x0, y0, x1, y1), or the frame for None; raise InputError if outside."""
        if value is None:
            return cls(0, 0, shape[1], shape[0])
        numbers = numbers_between("roi", value, integer=True)
        if numbers.shape != (4,):
            raise InputError("roi: expected x0, y0, x1, y1 in pixels")
        x0, y0, x1, y1 = (int(number) for number in numbers)
        if not (0 <= x0 < x1 <= shape[1] and 0 <= y0 < y1 <= shape[0]):
            raise InputError(
                f"roi = {x0}, {y0}, {x1}, {y1}: expected x0 < x1 and y0 < y1 within the frame's {shape[1]} "
                f"columns and {shape[0]} rows"
            )
        return cls(x0, y0, x1, y1)

    @property
    def slices(self) -> tuple[EllipsisType, slice, slice]:
        """Slices that cut the rectangle out of one or several frames."""
        return (..., slice(self.y0, self.y1), slice(self.x0, self.x1))


LEAST_DIFFERENCE = 0.1
"""Smaller differences between displacements of spots are treated as equal, in pitches."""
LEAST_DIFFERENCE_PX = 0.3
"""Likewise in px; the smaller one counts."""

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


def neighbour_vectors(geometry: str, pitch_px: float, angle_deg: float) -> NDArray[np.complex128]:
    """Return the vectors x + iy from a lenslet to its neighbours, diagonal ones in square arrays too [px]."""
    around = np.array([1, 1j, -1, -1j, 1 + 1j, -1 + 1j, -1 - 1j, 1 - 1j])
    if geometry == "hexagonal":
        around = np.exp(1j * np.pi / 3 * np.arange(6))
    return np.asarray(pitch_px * around * np.exp(1j * np.radians(angle_deg)))


def lines_of(neighbours: NDArray[np.int64], multiple: int) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Return pairs of cells in line with each cell, from the table that `neighbours_of` returns.

    They are opposite neighbours. Cells at the edge of the array, with fewer than two of these pairs, also
    have each neighbour with the next one behind it.

    Returns
    -------
    lines : (m, 2, p) array of int32
        n where there is none; those come last. p is n, or as much more as makes it a multiple of `multiple`.
    far : (m, p) array of float32
        Weight of the second cell of each pair in the line, 1 less that of the first: 0.5 if they are
        opposite; -1 if both are on the same side, the nearer one first.
    """
    n, count = neighbours.shape
    opposite = neighbours.reshape(n, count // 2, 2)
    few = (opposite < n).all(axis=2).sum(axis=1) < 2
    same_side = continued(neighbours)
    same_side[~few] = n
    lines = np.concatenate([opposite, same_side], axis=1)
    complete = (lines < n).all(axis=2)
    lines[~complete] = n
    order = np.argsort(~complete, axis=1, kind="stable")[:, : max(complete.sum(axis=1).max(), 1)]
    taken, outside = np.take_along_axis(lines, order[:, :, None], axis=1), order >= count // 2
    more = -n % multiple
    table = np.pad(taken.transpose(1, 2, 0), ((0, 0), (0, 0), (0, more)), constant_values=n)
    weight = np.where(n == taken[:, :, 0].T, np.nan, np.where(outside.T, -1.0, 0.5))
    far = np.pad(weight, ((0, 0), (0, more)), constant_values=np.nan)
    return np.ascontiguousarray(table, np.int32), np.ascontiguousarray(far, np.float32)


def continued(neighbours: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return each neighbour and the one behind it, (n, m, 2), from the table that `neighbours_of` returns."""
    n, count = neighbours.shape
    behind = np.vstack([neighbours, np.full(count, n)])[neighbours, np.arange(count)]
    return np.ascontiguousarray(np.stack([neighbours, behind], axis=2))


def as_rows(at: NDArray[np.complex128]) -> NDArray[np.float64]:
    """Return complex positions as rows of x, y."""
    return np.column_stack([at.real, at.imag])


def as_tree(at: NDArray[np.complex128]) -> scipy.spatial.cKDTree:
    """Return a tree of complex positions, in which near ones are found."""
    return scipy.spatial.cKDTree(as_rows(at))
