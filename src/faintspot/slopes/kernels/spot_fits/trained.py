"""The trained linear score: a few passes, each a scalar product of the image with a table at the position."""

from __future__ import annotations

import math
from typing import Any

from faintspot.slopes.kernels.compilation.compiling import compiled
from faintspot.slopes.kernels.compilation.simd import load, multiply_add, splat, sum_of, width_of
from faintspot.slopes.kernels.spot_fits.rows import rows_from_lanes
from faintspot.slopes.kernels.spot_fits.spot_rows import FLUX, HIGH_X, HIGH_Y, LOW_X, LOW_Y, X, Y


@compiled
def _products(lanes: Any, rows: Any, lane: Any, tables: Any, at: Any, length: Any, plane: Any) -> Any:
    """Sum a sub-aperture's image times the tables for x, from element `at`, and for y, `plane` later."""
    width = width_of(lanes)
    ny, vectors = rows.shape[0], rows.shape[1]
    zero = splat(lanes, 0.0)
    # Two sums each: the next multiplication need not wait for the last.
    even_x, odd_x, even_y, odd_y = zero, zero, zero, zero
    for vector in range(vectors):
        place = at + vector * width
        for row in range(0, ny - 1, 2):
            g = load(lanes, rows, ((row * vectors + vector) * width + lane) * width)
            even_x = multiply_add(g, load(lanes, tables, place), even_x)
            even_y = multiply_add(g, load(lanes, tables, place + plane), even_y)
            place += length
            g = load(lanes, rows, (((row + 1) * vectors + vector) * width + lane) * width)
            odd_x = multiply_add(g, load(lanes, tables, place), odd_x)
            odd_y = multiply_add(g, load(lanes, tables, place + plane), odd_y)
            place += length
        if ny % 2 == 1:
            g = load(lanes, rows, (((ny - 1) * vectors + vector) * width + lane) * width)
            even_x = multiply_add(g, load(lanes, tables, place), even_x)
            even_y = multiply_add(g, load(lanes, tables, place + plane), even_y)
    return float(sum_of(even_x + odd_x)), float(sum_of(even_y + odd_y))


@compiled
def apply_score(
    lanes: Any,
    image: Any,
    ny: Any,
    nx: Any,
    tables: Any,
    kinds: Any,
    steps_per_px: Any,
    margin: Any,
    lane_values: Any,
    starts: Any,
    rows: Any,
) -> None:
    """Improve X and Y of the W spots of a group: x <- q + sum psi(u - q) g / FLUX, q = x on the table's grid.

    Parameters
    ----------
    image : (>= ny * nx * W + W,)
    tables : (n_kinds, n_passes, phases, phases, 2, side, length) float32
        Kind and flux class together, pass, phase in y and x, axis, place in y and x: element i of phase p
        belongs to the offset i - margin + p / steps_per_px from q.
    kinds : (W,) int64
    margin : int
    lane_values : (LANE_ROWS * W,)
        X, Y and FLUX are read; X and Y are written.
    starts : (W,) int64
        Scratch.
    rows : (ny, n_vectors, W, W)
        Scratch.
    """
    width = width_of(lanes)
    passes, phases, side, length = tables.shape[1], tables.shape[2], tables.shape[5], tables.shape[6]
    half_x, half_y = 0.5 * nx, 0.5 * ny
    px_per_step = 1.0 / steps_per_px
    rows_from_lanes(lanes, image, ny, nx, starts, rows)
    # All sub-apertures make a pass before the next one: nothing then waits for its own last pass.
    for number in range(passes):
        for lane in range(width):
            # Within the window, and so within the tables; in this order NaN becomes a bound.
            from_x = min(max(-half_x, lane_values[X * width + lane]), half_x)
            from_y = min(max(-half_y, lane_values[Y * width + lane]), half_y)
            step_x = math.floor((-0.5 * (nx - 1) - from_x) * steps_per_px + 0.5)
            step_y = math.floor((-0.5 * (ny - 1) - from_y) * steps_per_px + 0.5)
            # In floating point: dividing whole numbers takes longer than a row of the image.
            whole_x, whole_y = math.floor(step_x * px_per_step), math.floor(step_y * px_per_step)
            phase = (step_y - whole_y * phases) * phases + (step_x - whole_x * phases)
            plane = ((kinds[lane] * passes + number) * phases * phases + int(phase)) * 2 * side * length
            at = plane + (int(whole_y) + margin) * length + int(whole_x) + margin
            sum_x, sum_y = _products(lanes, rows, lane, tables, at, length, side * length)
            inverse = 1.0 / lane_values[FLUX * width + lane]
            x = -0.5 * (nx - 1) - step_x * px_per_step + sum_x * inverse
            y = -0.5 * (ny - 1) - step_y * px_per_step + sum_y * inverse
            low, high = lane_values[LOW_X * width + lane], lane_values[HIGH_X * width + lane]
            lane_values[X * width + lane] = min(max(low, x), high)
            low, high = lane_values[LOW_Y * width + lane], lane_values[HIGH_Y * width + lane]
            lane_values[Y * width + lane] = min(max(low, y), high)
