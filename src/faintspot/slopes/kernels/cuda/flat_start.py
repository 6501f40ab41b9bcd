"""Starting point of the denoising by a warp: the dual field of a solution without structure.

The start is that of `total_variation.flat_start`, which says how and why. Cosine transforms along x and
eliminations along y happen in shared memory, a thread having a whole row or a whole column; from phi on, the
field is in registers, shared out as in the iterations.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import cuda, float32, uint32
from numpy.typing import NDArray

from faintspot.slopes.kernels.cuda import warp
from faintspot.slopes.kernels.cuda.compiling import device
from faintspot.slopes.kernels.cuda.strips import WARP, Strips
from faintspot.slopes.kernels.total_variation.flat_start import (
    FIRST_GUESS,
    LARGEST_STEP,
    LEAST_SLOPE,
    flat_start_table,
)

shuffle, warp_total, synchronise, inverse_root = warp.shuffle, warp.total, warp.synchronise, warp.inverse_root


def pitch_of(nx: int) -> int:
    """Numbers from row to row in shared memory: odd, so that the threads of a column use different banks."""
    return nx | 1


def half_cosines(nx: int) -> NDArray[np.float32]:
    """Return the left half of every cosine, (nx, (nx + 1) // 2)."""
    half = (nx + 1) // 2
    table: NDArray[np.float32] = flat_start_table(1, nx)[: nx * half].reshape(nx, half)
    return table


def inverse_pivots(window: tuple[int, int]) -> NDArray[np.float32]:
    """Return the eliminations' inverse pivots, (ny * nx,)."""
    ny, nx = window
    return np.ascontiguousarray(flat_start_table(ny, nx)[-ny * nx :])


def in_turn(parts: list[Any]) -> Any:
    """Return the function that calls others, one after the other: what a loop would do that is unrolled.

    The compiler does not unroll loops of this size; it then has to read cosines that could be part of
    instructions.
    """
    first = parts[0]
    if len(parts) == 1:
        return first
    others = in_turn(parts[1:])

    @device
    def run(values: Any, plane: Any, y: Any) -> None:
        first(values, plane, y)
        others(values, plane, y)

    return run


def make_terms(nx: int, k: int) -> Any:
    """Return the function that writes terms k and k + 2 of a row's cosine transform."""
    half, parity, k_next = (nx + 1) // 2, k % 2, min(k + 2, nx - 1 - (nx - 1 - k) % 2)
    cosines = half_cosines(nx)

    @device
    def write_terms(values: Any, plane: Any, y: Any) -> None:
        """`values`: sums and differences of mirrored pixels, (2, half)."""
        table = cuda.const.array_like(cosines)
        total, total_next = float32(0.0), float32(0.0)
        for i in range(half):
            total += table[k, i] * values[parity, i]
            total_next += table[k_next, i] * values[parity, i]
        plane[y, uint32(k)] = total
        plane[y, uint32(k_next)] = total_next

    return write_terms


def make_mirrored(nx: int, i: int) -> Any:
    """Return the function that turns the cosine transform back into pixel i and its mirror image."""
    cosines = half_cosines(nx)
    alone = 2 * i == nx - 1

    @device
    def write_pixels(values: Any, plane: Any, y: Any) -> None:
        """`values`: the transform, (nx,)."""
        table = cuda.const.array_like(cosines)
        even, odd = float32(0.0), float32(0.0)
        for k in range(0, nx, 2):
            even += table[k, i] * values[k]
        for k in range(1, nx, 2):
            odd += table[k, i] * values[k]
        plane[y, uint32(i)] = even + odd
        if not alone:
            plane[y, uint32(nx - 1 - i)] = even - odd

    return write_pixels


def make_transforms(nx: int) -> Any:
    """Return the functions that replace a row by its cosine transform, and the transform by the row."""
    half = (nx + 1) // 2
    write_terms = in_turn([make_terms(nx, k) for k in range(nx) if k % 4 < 2])
    write_pixels = in_turn([make_mirrored(nx, i) for i in range(half)])

    @device
    def transform(plane: Any, y: Any) -> None:
        values = cuda.local.array((2, half), float32)
        for i in range(half):
            left, right = plane[y, uint32(i)], plane[y, uint32(nx - 1 - i)]
            values[0, i] = left if 2 * i == nx - 1 else left + right
            values[1, i] = left - right
        write_terms(values, plane, y)

    @device
    def transform_back(plane: Any, y: Any) -> None:
        values = cuda.local.array(nx, float32)
        for k in range(nx):
            values[k] = plane[y, uint32(k)]
        write_pixels(values, plane, y)

    return transform, transform_back


def make_laplace(strips: Strips) -> Any:
    """Return the function that replaces an image in shared memory by phi, whose Laplacian it is."""
    ny, nx = strips.ny, strips.nx
    transform, transform_back = make_transforms(nx)

    @device
    def solve_laplace(plane: Any, pivots: Any, lane: Any) -> None:
        """`plane`: (ny, pitch) of the warp; `pivots`: (ny * nx,), the inverse ones."""
        for y in range(lane, ny, WARP):
            transform(plane, uint32(y))
        synchronise()
        if lane < nx:
            above = float32(0.0)
            for y in range(ny):
                value = plane[uint32(y), uint32(lane)] - above
                plane[uint32(y), uint32(lane)] = value
                above = value * pivots[uint32(y * nx + lane)]
            below = float32(0.0)
            for y in range(ny - 1, -1, -1):
                value = plane[uint32(y), uint32(lane)] - below
                below = value * pivots[uint32(y * nx + lane)]
                plane[uint32(y), uint32(lane)] = below
        synchronise()
        for y in range(lane, ny, WARP):
            transform_back(plane, uint32(y))
        synchronise()

    return solve_laplace


@device
def inside(x: Any, y: Any) -> Any:
    """1 where a vector is not longer than 1, else 0."""
    return float32(1.0) if x * x + y * y <= float32(1.0) else float32(0.0)


def make_norm_and_slope(strips: Strips) -> Any:
    """Return the function for ||div p||^2, p cut to length 1, and its product with what is not cut off."""
    rows, nx, mask = strips.rows, strips.nx, WARP - 1

    @device
    def norm_and_slope(gradient: Any, inverse: Any, lane: Any) -> Any:
        """`gradient`: of phi, (2, rows); `inverse`: 1 / lambda."""
        left, above = (lane - 1) & mask, (lane - nx) & mask
        norm, slope = float32(0.0), float32(0.0)
        x, y = gradient[0, rows - 1] * inverse, gradient[1, rows - 1] * inverse
        y_above = shuffle(y * inverse_root(max(x * x + y * y, float32(1.0))), above)
        free_above = shuffle(y * inside(x, y), above)
        for r in range(rows):
            x, y = gradient[0, r] * inverse, gradient[1, r] * inverse
            free = inside(x, y)
            free_x, free_y = x * free, y * free
            shrink = inverse_root(max(x * x + y * y, float32(1.0)))
            x *= shrink
            y *= shrink
            d = (x - shuffle(x, left)) + (y - y_above)
            norm += d * d
            slope += d * ((free_x - shuffle(free_x, left)) + (free_y - free_above))
            y_above, free_above = y, free_y
        return warp_total(norm), warp_total(slope)

    return norm_and_slope


@device
def better_multiplier(inverse: Any, norm: Any, slope: Any, radius: Any) -> Any:
    """Newton's step from 1 / lambda to the one for which ||div p|| = radius / lambda."""
    if norm <= float32(0.0):
        return inverse
    root = math.sqrt(norm)
    steepness = slope / (root * inverse)
    better = inverse + (root - radius * inverse) / max(radius - steepness, float32(LEAST_SLOPE) * radius)
    return max(min(better, float32(LARGEST_STEP) * inverse), float32(1.0 / LARGEST_STEP) * inverse)


def make_start_flat(strips: Strips) -> Any:
    """Return the function that writes the start into p and q, (2, rows) each."""
    rows, nx, last, pixels = strips.rows, strips.nx, strips.last_row, strips.ny * strips.nx
    solve_laplace, norm_and_slope = make_laplace(strips), make_norm_and_slope(strips)

    @device
    def start_flat(
        g: Any,
        plane: Any,
        pivots: Any,
        lane: Any,
        present: Any,
        in_row: Any,
        in_last: Any,
        radius: Any,
        p: Any,
        q: Any,
    ) -> Any:
        """Return 1 / lambda to go on with; arguments as `make_iterations` has them."""
        top, column = lane // nx * rows, lane % nx
        for r in range(rows):
            if r < present:
                plane[uint32(top + r), uint32(column)] = g[r]
        synchronise()
        solve_laplace(plane, pivots, lane)
        for r in range(rows):
            p[0, r] = p[1, r] = float32(0.0)
            if r < present:
                phi = plane[uint32(top + r), uint32(column)]
                if in_row > float32(0.0):
                    p[0, r] = plane[uint32(top + r), uint32(column + 1)] - phi
                if r < last or in_last > float32(0.0):
                    p[1, r] = plane[uint32(top + r + 1), uint32(column)] - phi
        inverse = math.sqrt(float32(pixels)) / (float32(FIRST_GUESS) * radius)
        norm, slope = norm_and_slope(p, inverse, lane)
        inverse = better_multiplier(inverse, norm, slope, radius)
        for r in range(rows):
            x, y = p[0, r] * inverse, p[1, r] * inverse
            shrink = inverse_root(max(x * x + y * y, float32(1.0)))
            p[0, r], p[1, r] = x * shrink, y * shrink
            q[0, r], q[1, r] = p[0, r], p[1, r]
        return inverse

    return start_flat
