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
    splat,
    store,
    width_of,
)
from faintspot.slopes.kernels.spot_fits.spot_rows import REST_X, X

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
