"""Products of a matrix with vectors and with slopes while rows arrive, and rows of telemetry."""

from typing import NamedTuple

import numpy as np

from faintspot.base.arrays import Array
from faintspot.base.flags import INVALID, UNMEASURED, SubapertureFlag
from faintspot.slopes.kernels.compiling import compiled, inlined

_UNMEASURED = int(UNMEASURED)
_LARGEST_PX = 1000.0
"""Larger slopes are not begun with: a sum from which they are taken away again would be inaccurate."""


class ProductPart(NamedTuple):
    """One thread's part of the product of a matrix with the slopes of a frame.

    `out`, summed over the threads, always is the product with `taken`. So whatever the slopes turn out to be,
    the whole product is that sum and the product with what they differ from `taken`.
    """

    columns: Array
    """(2 n, c) float32: the matrix, transposed; without rows: nothing is computed."""
    scale: float
    """Factor on measured slopes."""
    expected: Array
    """(2 n,) float64: subtracted from scaled slopes. Invalid sub-apertures give 0."""
    slopes: Array
    """(2 n,) float32: slopes of this frame so far, scaled, less `expected`."""
    taken: Array
    """(2 n,) float32"""
    out: Array
    """(c,) float32"""


NO_PRODUCT = ProductPart(
    np.zeros((0, 0), np.float32), 1.0, np.zeros(0), *(np.zeros(0, np.float32) for _ in range(3))
)
"""Stands for a product where none is wanted."""


@compiled
def add_products(columns: Array, vectors: Array, out: Array) -> None:
    """Add the products of a matrix with vectors.

    Parameters
    ----------
    columns : (m, c) array
        The matrix, transposed, so that results are what the processor works on side by side.
    vectors : (k, m) array
    out : (k, c) array
        All three float32, or all float64.
    """
    m, c = columns.shape
    whole = m - m % 4  # four rows at once: results are read and written a quarter as often
    for s in range(0, whole, 4):
        for k in range(vectors.shape[0]):
            a, b, d, e = vectors[k, s], vectors[k, s + 1], vectors[k, s + 2], vectors[k, s + 3]
            for i in range(c):
                out[k, i] += (columns[s, i] * a + columns[s + 1, i] * b) + (
                    columns[s + 2, i] * d + columns[s + 3, i] * e
                )
    for s in range(whole, m):
        for k in range(vectors.shape[0]):
            for i in range(c):
                out[k, i] += columns[s, i] * vectors[k, s]


@compiled
def add_changes(columns: Array, vector: Array, taken: Array, out: Array, start: int, stop: int) -> None:
    """Add the product with what elements [start, stop) of a vector differ from those taken before.

    Parameters
    ----------
    columns : (m, c) float32 array
        The matrix, transposed.
    vector, taken : (m,) float32 array
        `taken` becomes the vector.
    out : (c,) float32 array
        Product with `taken`.
    """
    c = columns.shape[1]
    whole = stop - (stop - start) % 4
    for s in range(start, whole, 4):
        a, b = vector[s] - taken[s], vector[s + 1] - taken[s + 1]
        d, e = vector[s + 2] - taken[s + 2], vector[s + 3] - taken[s + 3]
        if a != 0.0 or b != 0.0 or d != 0.0 or e != 0.0:
            for i in range(c):
                out[i] += (columns[s, i] * a + columns[s + 1, i] * b) + (
                    columns[s + 2, i] * d + columns[s + 3, i] * e
                )
    for s in range(whole, stop):
        a = vector[s] - taken[s]
        if a != 0.0:
            for i in range(c):
                out[i] += columns[s, i] * a
    for s in range(start, stop):
        taken[s] = vector[s]


@inlined
def is_measured(x: float, y: float, flags: int) -> bool:
    """Return whether a slope counts: its sub-aperture is valid, and both numbers are finite."""
    return flags & _UNMEASURED == 0 and np.isfinite(x) and np.isfinite(y)


@compiled
def add_slopes(part: ProductPart, x: Array, y: Array, flags: Array, start: int, stop: int) -> None:
    """Add the product with the slopes of sub-apertures [start, stop), which have been measured.

    What is not finite, or far too large, is left for `finish_product`: the sum stays finite, also that of a
    frame which is lost.

    Parameters
    ----------
    part : ProductPart
    x, y, flags : (n,) arrays
        As in `faintspot.Slopes`.
    """
    n, scale = x.shape[0], part.scale
    for s in range(start, stop):
        along, across = x[s] * scale, y[s] * scale
        measured = is_measured(along, across, flags[s])
        along, across = along - part.expected[s], across - part.expected[n + s]
        part.slopes[s] = along if measured and abs(along) < _LARGEST_PX else 0.0
        part.slopes[n + s] = across if measured and abs(across) < _LARGEST_PX else 0.0
    for first in (0, n):
        add_changes(part.columns, part.slopes, part.taken, part.out, first + start, first + stop)


class ProductMemory(NamedTuple):
    """Memory of a product with the slopes of a frame, of all threads."""

    slopes: Array
    """(m,) float32: see `ProductPart`."""
    taken: Array
    """(m,) float32: see `ProductPart`."""
    outs: Array
    """(threads, c) float32: `out` of each `ProductPart`."""
    result: Array
    """(c,) float32: the whole product."""


@compiled
def finish_product(columns: Array, vector: Array, memory: ProductMemory) -> None:
    """Write the product with a vector, of which a part may have been computed; of the next one, nothing is.

    Parameters
    ----------
    columns : (m, c) float32 array
        The matrix, transposed.
    vector : (m,) float64 array
    memory : ProductMemory
    """
    slopes, taken, outs, result = memory
    for s in range(slopes.shape[0]):
        slopes[s] = vector[s]
    add_changes(columns, slopes, taken, outs[0], 0, slopes.shape[0])
    for i in range(result.shape[0]):
        result[i] = outs[0, i]
    for k in range(1, outs.shape[0]):
        for i in range(result.shape[0]):
            result[i] += outs[k, i]
    taken[:] = 0.0
    outs[:] = 0.0


_INVALID, _NOT_CONVERGED = int(INVALID), int(SubapertureFlag.NOT_CONVERGED)


@compiled
def fill_telemetry_rows(
    flux: Array,
    flags: Array,
    iterations: Array,
    error_x: Array,
    error_y: Array,
    covariance_xy: Array,
    counts: Array,
    table: Array,
) -> None:
    """Fill a table (7, n), and count: invalid sub-apertures, those at the iteration limit, iterations.

    Rows of the table: flux, valid, standard errors of x and y, iterations, flags, covariance of x and y.
    """
    counts[0] = counts[1] = counts[2] = 0
    for s in range(flux.shape[0]):
        invalid = flags[s] & _INVALID != 0
        counts[0] += invalid
        counts[1] += flags[s] & _NOT_CONVERGED != 0
        counts[2] += iterations[s]
        table[0, s] = flux[s]
        table[1, s] = 0.0 if invalid else 1.0
        table[2, s] = error_x[s]
        table[3, s] = error_y[s]
        table[4, s] = iterations[s]
        table[5, s] = flags[s]
        table[6, s] = covariance_xy[s]
