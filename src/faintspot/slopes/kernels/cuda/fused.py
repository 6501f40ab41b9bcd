"""The kernel: from frames to slopes in one launch, a warp per sub-aperture.

One kernel per window, algorithm and kind of work, all of which are constants in it: then loops over a
thread's pixels are unrolled and its arrays are registers. Slopes do not depend on how many warps share a
block.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any

from numba import cuda, float32, int32

from faintspot.slopes.kernels.cuda.availability import simulated
from faintspot.slopes.kernels.cuda.brightest import (
    make_centroid,
    make_extremes,
    make_standard_errors,
    make_subtract,
    make_threshold,
)
from faintspot.slopes.kernels.cuda.compiling import device, kernel
from faintspot.slopes.kernels.cuda.flat_start import pitch_of
from faintspot.slopes.kernels.cuda.gather import make_fill, make_gather, make_recall, make_share, make_smooth
from faintspot.slopes.kernels.cuda.strips import WARP, Strips, strips_of
from faintspot.slopes.kernels.cuda.total_variation import make_denoise
from faintspot.slopes.kernels.driver.groups import (
    AT_SEARCH_LIMIT,
    ERROR_SCALE,
    EXCESS,
    LIMIT_ROUNDING_PX,
    MOST_BAD,
    NO_FLUX,
    RANGE,
    SATURATED,
    TOO_MANY_BAD_PIXELS,
    VARIANCE,
    ZERO_X,
    ZERO_Y,
)
from faintspot.slopes.kernels.gravity.gravity import (
    DENOISE,
    FLOOR,
    INFEASIBLE_STRENGTH,
    LEVEL,
    LIMIT,
    NOT_CONVERGED,
    RANK,
    SMOOTH,
    STRENGTH,
    SUBTRACT,
    TOLERANCE,
)

WARPS = 1 if simulated() else 2  # in a block; the twins of the simulator know of one
FEWEST_BLOCKS = 1 if simulated() else 128  # Numba warns of fewer; those without a sub-aperture end at once


# Rows of the kernel's results (n_rows, n_frames, n_subapertures): float32, and int32.
X, Y, FLUX, ERROR_X, ERROR_Y, COVARIANCE = range(6)
ITERATIONS, BAD_COUNT = range(2)

LARGEST_ERROR_PX = 1e15
"""Standard errors count as at most this in a covariance, which stays finite."""


@device
def within(slope: Any, reach: Any) -> Any:
    """Keep a slope within the allowed range."""
    return min(max(slope, -reach), reach)


@device
def judge(bad: Any, saturated: Any, most_bad: Any, converged: Any, infeasible: Any) -> Any:
    """Flags of a sub-aperture as far as its flux does not matter."""
    bits = int32(SATURATED) if saturated > float32(0.0) else int32(0)
    if bad > most_bad:
        return bits | int32(TOO_MANY_BAD_PIXELS)  # which says it all
    if infeasible:
        bits |= int32(INFEASIBLE_STRENGTH)
    if not converged:
        bits |= int32(NOT_CONVERGED)
    return bits


def make_store(strips: Strips) -> Any:
    """Return the function that writes a sub-aperture's result; the reference where it is invalid."""
    half_x, half_y = 0.5 * strips.nx, 0.5 * strips.ny

    @device
    def store(
        table: Any,
        f: Any,
        s: Any,
        bits: Any,
        brightest: Any,
        found: Any,
        errors: Any,
        numbers: Any,
        flags: Any,
    ) -> None:
        """`found`: flux, x, y; `errors`: of x and y, and their correlation."""
        total, x, y = found
        # A nearly flat image leaves round-off only; negative pixels can throw a centroid out of its window.
        illuminated = total > table[FLOOR, s] * brightest
        inside = abs(x) <= float32(half_x) and abs(y) <= float32(half_y)
        if not (bits & int32(TOO_MANY_BAD_PIXELS) or (illuminated and inside)):
            bits |= int32(NO_FLUX)
        valid = bits & int32(NO_FLUX | TOO_MANY_BAD_PIXELS) == 0
        known = valid and table[VARIANCE, s] >= float32(0.0)
        reach, scale = table[RANGE, s], table[ERROR_SCALE, s]
        away_x, away_y = x - table[ZERO_X, s], y - table[ZERO_Y, s]
        numbers[X, f, s] = within(away_x, reach) if valid else float32(0.0)
        numbers[Y, f, s] = within(away_y, reach) if valid else float32(0.0)
        if valid and max(abs(away_x), abs(away_y)) >= reach - float32(LIMIT_ROUNDING_PX):
            bits |= int32(AT_SEARCH_LIMIT)
        numbers[FLUX, f, s] = total
        numbers[ERROR_X, f, s] = scale * errors[0] if known else float32(math.inf)
        numbers[ERROR_Y, f, s] = scale * errors[1] if known else float32(math.inf)
        limit = float32(LARGEST_ERROR_PX)
        largest = min(numbers[ERROR_X, f, s], limit) * min(numbers[ERROR_Y, f, s], limit)
        numbers[COVARIANCE, f, s] = within(errors[2], float32(1.0)) * largest if known else float32(0.0)
        flags[f, s] = bits

    return store


def make_locate(strips: Strips) -> Any:
    """Return the function for background, centre of gravity and its standard errors."""
    rows = strips.rows
    extremes, find_threshold = make_extremes(strips), make_threshold(strips)
    subtract, centroid = make_subtract(strips), make_centroid(strips)
    standard_errors, recall = make_standard_errors(strips), make_recall(strips)

    @device
    def locate(
        image: Any, tile: Any, table: Any, s: Any, top: Any, column: Any, present: Any, away: Any
    ) -> Any:
        """`tile`: the image before it was denoised; `away`: x and y of the thread's first pixel, px.

        Return the largest magnitude, (flux, x, y), and the errors of x and y with their correlation.
        """
        low, high, total = extremes(image, present)
        threshold = table[LEVEL, s]
        if table[RANK, s] > float32(0.0):
            threshold = find_threshold(image, present, table[RANK, s], low, high, total)
        subtract(image, present, threshold, threshold * table[SUBTRACT, s])
        found = centroid(image, away[0], away[1])
        errors = (float32(math.inf), float32(math.inf), float32(0.0))
        if table[VARIANCE, s] >= float32(0.0):
            measured = cuda.local.array(rows, float32)
            recall(tile, top, column, present, measured)
            errors = standard_errors(
                measured,
                image,
                away[0] - found[1],
                away[1] - found[2],
                table[VARIANCE, s],
                table[EXCESS, s],
                found[0],
            )
        return max(abs(low), abs(high)), found, errors

    return locate


@cache
def slopes_kernel(window: tuple[int, int], before: int, algorithm: bool | None, warps: int = WARPS) -> Any:
    """Return the kernel for a window (ny, nx).

    Launch it with `warps` * 32 threads a block; blocks along x are a frame's, along y the frames. It takes
    frames (n_frames, h * w) uint16 or float32; w and places (n,), each window's first pixel, both int32;
    maps of dark and electrons per ADU (2, h * w), saturation, tables (n_variants, rows, n) and taps
    (n, 2, 1 + reach), inverse pivots (h * w,) for the denoising (`kernels.total_variation.flat_start`), all
    float32; variants (n_frames,) int32; and writes numbers (6, n_frames, n) float32,
    counts (2, n_frames, n) int32 and flags (n_frames, n) uint8.

    Raises
    ------
    InputError
        If the window is too large for a warp.
    """
    strips = strips_of(window)
    ny, nx, rows, threads, last = strips.ny, strips.nx, strips.rows, strips.threads, strips.strips - 1
    centre_x, centre_y = 0.5 * (nx - 1), 0.5 * (ny - 1)
    full = strips.full
    pitch, flat_rows = pitch_of(nx), ny if before == DENOISE else 1
    planes = 3 if before == SMOOTH else 2
    gather, share, fill = make_gather(strips), make_share(strips), make_fill(strips)
    recall, smooth, denoise = make_recall(strips), make_smooth(strips), make_denoise(strips, algorithm)
    locate, store = make_locate(strips), make_store(strips)

    @kernel
    def slopes(
        frames: Any,
        line: Any,
        places: Any,
        maps: Any,
        saturation: Any,
        tables: Any,
        variants: Any,
        taps: Any,
        pivots: Any,
        numbers: Any,
        counts: Any,
        flags: Any,
    ) -> None:
        lane, block_warp = cuda.threadIdx.x % WARP, cuda.threadIdx.x // WARP
        s, f = cuda.blockIdx.x * warps + block_warp, cuda.blockIdx.y
        if s >= places.shape[0]:
            return
        table = tables[variants[f]]
        strip, column = lane // nx, lane % nx
        top = strip * rows
        present = rows
        if not full:
            present = min(rows, ny - top) if lane < threads else 0
        tiles = cuda.shared.array((planes, warps, ny, nx), float32)
        tile, scratch = tiles[0, block_warp], tiles[1, block_warp]
        image = cuda.local.array(rows, float32)
        place = places[s] + top * line + column
        bad, saturated = gather(frames[f], maps[0], maps[1], line, place, present, saturation, image)
        share(image, top, column, present, tile)
        if bad > float32(0.0):
            fill(tile, lane, scratch)
            recall(scratch, top, column, present, image)
            share(image, top, column, present, tile)
        iterations, converged, infeasible = int32(0), True, False
        plane = cuda.shared.array((warps, flat_rows, pitch), float32)[block_warp]
        if before == DENOISE:
            iterations, converged, infeasible = denoise(
                image,
                lane,
                present,
                float32(1.0) if lane < threads and column < nx - 1 else float32(0.0),
                float32(1.0) if strip < last else float32(0.0),
                table[STRENGTH, s],
                table[TOLERANCE, s],
                int32(table[LIMIT, s]),
                plane,
                pivots,
            )
        elif before == SMOOTH:
            smoothed = tiles[planes - 1, block_warp]
            smooth(tile, taps[s], lane, scratch, smoothed)
            recall(smoothed, top, column, present, image)
        away = (float32(column) - float32(centre_x), float32(top) - float32(centre_y))
        brightest, found, errors = locate(image, tile, table, s, top, column, present, away)
        if lane == 0:
            settled = converged or table[TOLERANCE, s] <= float32(0.0)  # without a tolerance, nothing fails
            bits = judge(bad, saturated, table[MOST_BAD, s], settled, infeasible)
            counts[ITERATIONS, f, s] = iterations
            counts[BAD_COUNT, f, s] = int32(bad)
            store(table, f, s, bits, brightest, found, errors, numbers, flags)

    return slopes
