"""Profiles of the spot at any position, out of tables: one for each lane, pixels of all lanes side by side.

A table holds a profile at PHASES places a pixel. Between them it is continued by its derivative, which is in
the table as well: the error is below 5e-4 of the profile's curvature.
"""

from __future__ import annotations

import math
from typing import Any

from faintspot.slopes.kernels.compilation.compiling import compiled
from faintspot.slopes.kernels.compilation.simd import (
    copy_transposed,
    load,
    maximum,
    minimum,
    multiply_add,
    select,
    splat,
    store,
    width_of,
)
from faintspot.slopes.kernels.gravity.smoothing import smooth_pixel
from faintspot.slopes.kernels.spot_fits.spot_rows import (
    FLUX,
    HIGH_X,
    HIGH_Y,
    LOW_X,
    LOW_Y,
    REST_X,
    START_FLUX,
    X,
    Y,
)

PHASES = 16
MARGIN = 2  # px that a table reaches beyond the window's side, on either end


@compiled
def look_up(
    lanes: Any, tables: Any, which: Any, ny: Any, nx: Any, lane_values: Any, starts: Any, profiles: Any
) -> None:
    """Write every lane's profiles, and their derivatives in the position, at its position X, Y.

    Parameters
    ----------
    lanes : Lanes
    tables : (n_models, 2, rank, 2, PHASES, length) float32
        Axis (x, y), term, value or derivative, phase, place: element i of phase p belongs to the offset
        i - MARGIN - max(ny, nx) + p / PHASES from the spot.
    which : (W,) int64
        Model of each lane.
    ny, nx : int
    lane_values : (LANE_ROWS * W,)
        X and Y are read, REST_X and REST_Y written.
    starts : (W,) int64
        Scratch.
    profiles : (2, rank, 2, padded, W) float32
        Written for the first nx or ny of `padded` pixels.
    """
    width = width_of(lanes)
    rank, length, padded = tables.shape[2], tables.shape[5], profiles.shape[3]
    margin = MARGIN + max(ny, nx)
    for axis in range(2):
        n = nx if axis == 0 else ny
        first = -0.5 * (n - 1)
        # Within the window, and so within the tables; NaN becomes a bound.
        inside = maximum(load(lanes, lane_values, (X + axis) * width), splat(lanes, -0.5 * n))
        store(lane_values, (REST_X + axis) * width, minimum(inside, splat(lanes, 0.5 * n)))
        for lane in range(width):
            position = lane_values[(REST_X + axis) * width + lane]
            step = math.floor((first - position) * PHASES + 0.5)
            whole, phase = step // PHASES, step % PHASES
            starts[lane] = ((which[lane] * 2 + axis) * rank * 2 * PHASES + phase) * length + whole + margin
            lane_values[(REST_X + axis) * width + lane] = position - (first - step / PHASES)
        rest = load(lanes, lane_values, (REST_X + axis) * width)
        for term in range(rank):
            for kind in range(2):
                plane = (term * 2 + kind) * PHASES * length
                to = ((axis * rank + term) * 2 + kind) * padded
                for i in range(0, n, width):
                    copy_transposed(lanes, tables, starts, plane + i, profiles, (to + i) * width)
            value = (axis * rank + term) * 2 * padded
            for i in range(n):
                derivative = load(lanes, profiles, (value + padded + i) * width)
                here = (value + i) * width
                store(profiles, here, multiply_add(rest, derivative, load(lanes, profiles, here)))


LEAST_FLUX_E = 1.0  # an estimate of the flux below this says nothing


@compiled
def _pixel_range(lanes: Any, lane_values: Any, low: Any, high: Any, n: Any) -> Any:
    """First and last pixel whose centre is within half a pixel of some lane's allowed positions."""
    width = width_of(lanes)
    first, last = n - 1, 0
    for lane in range(width):
        lowest, highest = lane_values[low * width + lane], lane_values[high * width + lane]
        first = min(first, math.ceil(lowest - 0.5 + 0.5 * (n - 1)))
        last = max(last, math.floor(highest + 0.5 + 0.5 * (n - 1)))
    return max(first, 0), min(last, n - 1)


@compiled
def find_start(
    lanes: Any, image: Any, ny: Any, nx: Any, reach: Any, taps: Any, smoothed: Any, lane_values: Any
) -> None:
    """Write X, Y and FLUX of every lane: its largest smoothed pixel within the allowed positions.

    Of equal ones the first. FLUX follows from what such a pixel has of a spot's flux, START_FLUX.

    Parameters
    ----------
    image : (ny * nx * W,)
    reach, taps
        See `smooth_pixel`.
    smoothed : (>= ny * nx * W,), flat
        Scratch.
    """
    width = width_of(lanes)
    first_x, last_x = _pixel_range(lanes, lane_values, LOW_X, HIGH_X, nx)
    first_y, last_y = _pixel_range(lanes, lane_values, LOW_Y, HIGH_Y, ny)
    for y in range(max(first_y - reach, 0), min(last_y + reach + 1, ny)):
        for x in range(first_x, last_x + 1):
            at = (y * nx + x) * width
            store(smoothed, at, smooth_pixel(lanes, image, at, width, x, nx, taps, 0, reach))
    half, minus_half = splat(lanes, 0.5), splat(lanes, -0.5)
    low_x, high_x = load(lanes, lane_values, LOW_X * width), load(lanes, lane_values, HIGH_X * width)
    low_y, high_y = load(lanes, lane_values, LOW_Y * width), load(lanes, lane_values, HIGH_Y * width)
    best = splat(lanes, -math.inf)
    best_x, best_y = half * (low_x + high_x), half * (low_y + high_y)
    for y in range(first_y, last_y + 1):
        v = splat(lanes, y - 0.5 * (ny - 1))
        for x in range(first_x, last_x + 1):
            value = smooth_pixel(lanes, smoothed, (y * nx + x) * width, nx * width, y, ny, taps, 1, reach)
            u = splat(lanes, x - 0.5 * (nx - 1))
            inside = minimum(minimum(u - low_x, high_x - u), minimum(v - low_y, high_y - v)) >= minus_half
            value = select(inside, value, splat(lanes, -math.inf))
            larger = value > best
            best = select(larger, value, best)
            best_x, best_y = select(larger, u, best_x), select(larger, v, best_y)
    flux = best / load(lanes, lane_values, START_FLUX * width)
    store(lane_values, X * width, minimum(maximum(best_x, low_x), high_x))
    store(lane_values, Y * width, minimum(maximum(best_y, low_y), high_y))
    store(lane_values, FLUX * width, maximum(flux, splat(lanes, LEAST_FLUX_E)))
