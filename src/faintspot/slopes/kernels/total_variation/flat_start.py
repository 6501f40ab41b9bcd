"""Starting point of the denoising of a group: the dual field of a solution without structure.

Where the strength is close to the image's own rms, the solution is nearly flat and div p nearly g / lambda
everywhere; p then has to carry light across the whole image, for which sweeps that start from zero, one pixel
each, take 60 and more. p = grad phi / lambda with the Laplacian of phi being g has that divergence at once.
Cut to the length that p may have, it is a start for all other strengths, too, with a multiplier that makes it
obey the constraint.

The Laplace equation, with Neumann edges, is solved by cosine transforms along x and elimination along y.
"""

import math
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from faintspot.base.arrays import Array
from faintspot.slopes.kernels.compiling import compiled, inlined
from faintspot.slopes.kernels.simd import (
    Lanes,
    Pair,
    Vector,
    get,
    load,
    maximum,
    minimum,
    multiply_add,
    select,
    splat,
    square_root,
    store,
    twice_reciprocal_square_root,
    width_of,
)
from faintspot.slopes.kernels.total_variation.sweeps import IMAGE, STATE_VECTORS, store_projected

FIRST_GUESS = 1.6  # of the multiplier, in units of the strength: the middle of what occurs, 0.5 to 3.5
MOMENTUM_AGE = 4.0  # the accelerated iteration begins as if it had run for some time
LEAST_SLOPE, LARGEST_STEP = 0.3, 4.0  # keep Newton's step in hand


@cache
def flat_start_table(ny: int, nx: int, dtype: DTypeLike = np.float32) -> NDArray[Any]:
    """Return cosines (nx, (nx + 1) // 2), then the eliminations' inverse pivots (ny, nx), in one row.

    Row k of the cosines is half of the k-th orthonormal one; the other half is its mirror image, with the
    sign of (-1)^k.
    """
    k, x = np.arange(nx)[:, None], np.arange((nx + 1) // 2)
    cosines = math.sqrt(2.0 / nx) * np.cos(np.pi * k * (2 * x + 1) / (2 * nx))
    cosines[0] /= math.sqrt(2.0)
    eigenvalues = 2.0 * np.cos(np.pi * np.arange(nx) / nx) - 2.0
    diagonal = np.full((ny, nx), -2.0) + eigenvalues
    diagonal[[0, -1]] += 1.0
    inverse = np.empty((ny, nx))
    inverse[0] = 1.0 / diagonal[0]
    for y in range(1, ny):
        pivot = diagonal[y] - inverse[y - 1]
        if y == ny - 1:
            pivot[0] = math.inf  # the mean of phi is free: zero in its last row
        inverse[y] = 1.0 / pivot
    return np.concatenate([cosines.ravel(), inverse.ravel()]).astype(dtype)


@inlined
def _product(lanes: Lanes, table: Array, entry: int, vectors: Array, place: int, total: Vector) -> Vector:
    return multiply_add(splat(lanes, get(table, entry)), load(lanes, vectors, place), total)


@compiled
def _transform_row(lanes: Lanes, rows: Array, nx: int, table: Array, pairs: int, to: int) -> None:
    """Cosine transform of a row given as sums and differences of mirrored pixels, from place `pairs`."""
    width = width_of(lanes)
    zero, half = splat(lanes, 0.0), (nx + 1) // 2
    for parity in range(2):
        source, k = pairs + parity * half * width, parity
        while k + 6 < nx:  # four at a time: fewer loads, and sums that do not wait for each other
            a, b, c, d = zero, zero, zero, zero
            for i in range(half):
                entry, place = k * half + i, source + i * width
                a = _product(lanes, table, entry, rows, place, a)
                b = _product(lanes, table, entry + 2 * half, rows, place, b)
                c = _product(lanes, table, entry + 4 * half, rows, place, c)
                d = _product(lanes, table, entry + 6 * half, rows, place, d)
            store(rows, to + k * width, a)
            store(rows, to + (k + 2) * width, b)
            store(rows, to + (k + 4) * width, c)
            store(rows, to + (k + 6) * width, d)
            k += 8
        while k < nx:
            a = zero
            for i in range(half):
                a = _product(lanes, table, k * half + i, rows, source + i * width, a)
            store(rows, to + k * width, a)
            k += 2


@compiled
def _transform_back(lanes: Lanes, rows: Array, nx: int, table: Array, source: int, to: int) -> None:
    """Turn the cosine transform of a row back into the row."""
    width = width_of(lanes)
    zero, half = splat(lanes, 0.0), (nx + 1) // 2
    i = 0
    while i + 3 < half:  # four at a time, as above
        a, b, c, d, e, f, g, h = zero, zero, zero, zero, zero, zero, zero, zero
        for k in range(0, nx, 2):
            entry, place = k * half + i, source + k * width
            a = _product(lanes, table, entry, rows, place, a)
            b = _product(lanes, table, entry + 1, rows, place, b)
            c = _product(lanes, table, entry + 2, rows, place, c)
            d = _product(lanes, table, entry + 3, rows, place, d)
            if k + 1 < nx:
                entry, place = entry + half, place + width
                e = _product(lanes, table, entry, rows, place, e)
                f = _product(lanes, table, entry + 1, rows, place, f)
                g = _product(lanes, table, entry + 2, rows, place, g)
                h = _product(lanes, table, entry + 3, rows, place, h)
        _store_mirrored(lanes, rows, nx, to, i, a, e)
        _store_mirrored(lanes, rows, nx, to, i + 1, b, f)
        _store_mirrored(lanes, rows, nx, to, i + 2, c, g)
        _store_mirrored(lanes, rows, nx, to, i + 3, d, h)
        i += 4
    while i < half:
        even, odd = zero, zero
        for k in range(0, nx, 2):
            entry, place = k * half + i, source + k * width
            even = _product(lanes, table, entry, rows, place, even)
            if k + 1 < nx:
                odd = _product(lanes, table, entry + half, rows, place + width, odd)
        _store_mirrored(lanes, rows, nx, to, i, even, odd)
        i += 1


@inlined
def _store_mirrored(lanes: Lanes, rows: Array, nx: int, to: int, i: int, even: Vector, odd: Vector) -> None:
    """Store pixel i of a row and its mirror image; in the middle of a row, what is odd is zero."""
    width = width_of(lanes)
    store(rows, to + (nx - 1 - i) * width, even - odd)
    store(rows, to + i * width, even + odd)


@compiled
def _solve_laplace(lanes: Lanes, state: Array, rows: Array, ny: int, nx: int, table: Array) -> None:
    """Write phi, whose Laplacian is the image in the state, into the first ny * nx vectors of `rows`."""
    width = width_of(lanes)
    half, pivots = (nx + 1) // 2, nx * ((nx + 1) // 2)
    row, spare = nx * width, ny * nx * width
    for y in range(ny):
        image = (y * nx * STATE_VECTORS + IMAGE) * width
        for i in range(half):
            left = load(lanes, state, image + i * STATE_VECTORS * width)
            right = load(lanes, state, image + (nx - 1 - i) * STATE_VECTORS * width)
            middle = 2 * i == nx - 1
            store(rows, spare + i * width, left if middle else left + right)
            store(rows, spare + (half + i) * width, left - right)
        _transform_row(lanes, rows, nx, table, spare, y * row)
        if y > 0:
            for k in range(nx):
                factor = splat(lanes, get(table, pivots + (y - 1) * nx + k))
                here = y * row + k * width
                store(rows, here, load(lanes, rows, here) - factor * load(lanes, rows, here - row))
    for y in range(ny - 1, -1, -1):
        for k in range(nx):
            value = load(lanes, rows, y * row + k * width)
            if y < ny - 1:
                value = value - load(lanes, rows, spare + k * width)
            store(rows, spare + k * width, value * splat(lanes, get(table, pivots + y * nx + k)))
        _transform_back(lanes, rows, nx, table, spare, y * row)


@inlined
def _field(lanes: Lanes, rows: Array, y: int, x: int, ny: int, nx: int, twice_inverse: Vector) -> Pair:
    """2 grad phi / lambda at one pixel."""
    width = width_of(lanes)
    here = (y * nx + x) * width
    phi = load(lanes, rows, here)
    right = load(lanes, rows, here + (width if x < nx - 1 else 0))
    below = load(lanes, rows, here + (nx * width if y < ny - 1 else 0))
    return (right - phi) * twice_inverse, (below - phi) * twice_inverse


@compiled
def _norm_and_slope(lanes: Lanes, rows: Array, ny: int, nx: int, twice_inverse: Vector) -> Pair:
    """Squared norm of 2 div p, p cut to length 1, and its product with what is not cut off from it."""
    width = width_of(lanes)
    zero, four = splat(lanes, 0.0), splat(lanes, 4.0)
    above = ny * nx * width
    for i in range(2 * nx):
        store(rows, above + i * width, zero)
    norm, slope = zero, zero
    for y in range(ny):
        left, free_left = zero, zero
        for x in range(nx):
            px, py = _field(lanes, rows, y, x, ny, nx, twice_inverse)
            square = multiply_add(px, px, py * py)
            shrink = twice_reciprocal_square_root(maximum(square, four))
            px, py = px * shrink, py * shrink
            free_x, free_y = select(square <= four, px, zero), select(square <= four, py, zero)
            place = above + 2 * x * width
            d = (px - left) + (py - load(lanes, rows, place))
            free = (free_x - free_left) + (free_y - load(lanes, rows, place + width))
            store(rows, place, py)
            store(rows, place + width, free_y)
            norm = multiply_add(d, d, norm)
            slope = multiply_add(d, free, slope)
            left, free_left = px, free_x
    return norm, slope


@compiled
def start_flat(
    lanes: Lanes, state: Array, rows: Array, ny: int, nx: int, table: Array, inverse_radius: Vector
) -> Vector:
    """Write 2 p of the start into the state's first version; return 1 / lambda to go on with.

    The multiplier is one Newton step from the first guess towards the one for which the field obeys the
    constraint, ||div p|| = radius / lambda.

    Parameters
    ----------
    state, rows : arrays
        See `denoise_group`; `rows` is overwritten.
    table : array
        From `flat_start_table`.
    inverse_radius : vector
        1 / (sqrt(N) strength) of the normalised image.
    """
    width = width_of(lanes)
    zero, one, half = splat(lanes, 0.0), splat(lanes, 1.0), splat(lanes, 0.5)
    twice = splat(lanes, 2.0)
    _solve_laplace(lanes, state, rows, ny, nx, table)
    inverse = inverse_radius * splat(lanes, math.sqrt(ny * nx) / FIRST_GUESS)
    norm, slope = _norm_and_slope(lanes, rows, ny, nx, twice * inverse)
    illuminated = norm > zero
    norm = half * square_root(select(illuminated, norm, one))
    radius = one / inverse_radius
    steepness = half * half * slope / (norm * inverse)
    denominator = maximum(radius - steepness, splat(lanes, LEAST_SLOPE) * radius)
    better = inverse + (norm - radius * inverse) / denominator
    better = minimum(better, splat(lanes, LARGEST_STEP) * inverse)
    better = maximum(better, splat(lanes, 1.0 / LARGEST_STEP) * inverse)
    inverse = select(illuminated, better, inverse)
    for y in range(ny):
        for x in range(nx):
            px, py = _field(lanes, rows, y, x, ny, nx, twice * inverse)
            place = (y * nx + x) * STATE_VECTORS * width
            store_projected(lanes, state, place, px, py)
    return inverse
