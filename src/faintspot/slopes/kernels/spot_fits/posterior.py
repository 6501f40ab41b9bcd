"""The posterior of a spot's position on a grid: at very low flux it is far from a normal distribution.

With the flux F known, the logarithm of the (quasi-)likelihood of an image g at a position p is linear in g,
sum g k_p + c_p: a scalar product with a table for every position. For pixels of variance v + e m,
k_p = log(1 + e m_p / v) / e and c_p = sum v / e^2 log(1 + e m_p / v) - m_p / e.
"""

from __future__ import annotations

import math
from typing import Any

from faintspot.slopes.kernels.compilation.compiling import compiled
from faintspot.slopes.kernels.compilation.simd import (
    copy_transposed,
    load,
    multiply_add,
    splat,
    store,
    sum_of,
    width_of,
)
from faintspot.slopes.kernels.spot_fits.spot_rows import (
    HIGH_X,
    HIGH_Y,
    LOW_X,
    LOW_Y,
    MEAN_X,
    MEAN_Y,
    PRIOR_WEIGHT,
    PRIOR_X,
    PRIOR_Y,
    SPACING,
    SPREAD_X,
    SPREAD_XY,
    SPREAD_Y,
)


@compiled
def rows_from_lanes(lanes: Any, image: Any, ny: Any, nx: Any, starts: Any, rows: Any) -> None:
    """Reorder a group's images.

    Parameters
    ----------
    image : (>= ny * nx * W + W,)
        All lanes of a pixel side by side.
    starts : (W,) int64
        Scratch.
    rows : (ny, n_vectors, W, W)
        Written: pixel `vector * W + i` of a row of sub-aperture `lane` is at [row, vector, lane, i].
    """
    width = width_of(lanes)
    vectors = rows.shape[1]
    nothing = ny * nx * width
    store(image, nothing, splat(lanes, 0.0))
    for vector in range(vectors):
        first = vector * width
        whole = first + width <= nx
        for i in range(width):
            starts[i] = (first + i) * width
        for y in range(ny):
            shift = y * nx * width
            if not whole:
                for i in range(nx - first, width):
                    starts[i] = nothing - shift
            copy_transposed(lanes, image, starts, shift, rows, (y * vectors + vector) * width * width)


REACH = 4.0  # standard deviations of the prior beyond which no position is looked at
_NEGLIGIBLE = 25.0  # differences of the logarithm that count as probability 0


@compiled
def _share(position: Any, spacing: Any, low: Any, high: Any) -> Any:
    """Return the fraction of a grid point's cell within the allowed positions."""
    return min(position + 0.5 * spacing, high) - max(position - 0.5 * spacing, low)


@compiled
def _log_likelihood(lanes: Any, rows: Any, lane: Any, tables: Any, table: Any, position: Any) -> Any:
    """Return the sum of the image times the table of a position."""
    width = width_of(lanes)
    count = rows.shape[0] * rows.shape[1]
    at = (table * tables.shape[1] + position) * count * width
    # Two sums: the next multiplication need not wait for the last.
    even, odd = splat(lanes, 0.0), splat(lanes, 0.0)
    for row in range(0, count - 1, 2):
        g = load(lanes, rows, (row * width + lane) * width)
        even = multiply_add(g, load(lanes, tables, at + row * width), even)
        g = load(lanes, rows, ((row + 1) * width + lane) * width)
        odd = multiply_add(g, load(lanes, tables, at + (row + 1) * width), odd)
    if count % 2 == 1:
        g = load(lanes, rows, ((count - 1) * width + lane) * width)
        even = multiply_add(g, load(lanes, tables, at + (count - 1) * width), even)
    return float(sum_of(even + odd))


@compiled
def posterior_of_group(
    lanes: Any,
    image: Any,
    ny: Any,
    nx: Any,
    tables: Any,
    constants: Any,
    grid: Any,
    spacing: Any,
    which: Any,
    lane_values: Any,
    starts: Any,
    rows: Any,
    values: Any,
) -> None:
    """Write mean, standard deviation and covariance of the posterior of the W spots of a group.

    Parameters
    ----------
    image : (>= ny * nx * W + W,)
    tables : (n_tables, n_positions, ny, n_vectors * W) float32
        k_p, zero beyond nx.
    constants : (n_tables, n_positions) float32
        c_p.
    grid : (n_positions, 2) float32
        x and y, px.
    spacing : float
        Of the grid, px.
    which : (W,) int64
        Table of each lane.
    lane_values : (LANE_ROWS * W,)
        Allowed positions and prior are read.
    starts : (W,) int64
        Scratch.
    rows : (ny, n_vectors, W, W)
        Scratch.
    values : (n_positions,) float64
        Scratch.
    """
    width = width_of(lanes)
    n = grid.shape[0]
    rows_from_lanes(lanes, image, ny, nx, starts, rows)
    for lane in range(width):
        low_x, high_x = lane_values[LOW_X * width + lane], lane_values[HIGH_X * width + lane]
        low_y, high_y = lane_values[LOW_Y * width + lane], lane_values[HIGH_Y * width + lane]
        prior = float(lane_values[PRIOR_WEIGHT * width + lane])
        prior_x, prior_y = (
            float(lane_values[PRIOR_X * width + lane]),
            float(lane_values[PRIOR_Y * width + lane]),
        )
        largest = -math.inf
        for i in range(n):
            x, y = float(grid[i, 0]), float(grid[i, 1])
            share_x, share_y = _share(x, spacing, low_x, high_x), _share(y, spacing, low_y, high_y)
            values[i] = -math.inf
            away_x, away_y = (x - prior_x) ** 2 * prior, (y - prior_y) ** 2 * prior
            if share_x > 0.0 and share_y > 0.0 and max(away_x, away_y) <= REACH * REACH:
                value = _log_likelihood(lanes, rows, lane, tables, which[lane], i)
                value += constants[which[lane], i] - 0.5 * (away_x + away_y)
                values[i] = value
                largest = max(largest, value)
        total, sum_x, sum_y, squares_x, squares_y, products = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for i in range(n):
            if values[i] > largest - _NEGLIGIBLE:
                x, y = float(grid[i, 0]), float(grid[i, 1])
                weight = math.exp(values[i] - largest)
                weight *= _share(x, spacing, low_x, high_x) * _share(y, spacing, low_y, high_y)
                total += weight
                sum_x += weight * x
                sum_y += weight * y
                squares_x += weight * x * x
                squares_y += weight * y * y
                products += weight * x * y
        known = total > 0.0 and total < math.inf
        inverse = 1.0 / total if known else 0.0
        # Without a point of the grid in reach, the prior is all there is: it is narrower than the grid.
        x, y = (sum_x * inverse, sum_y * inverse) if known else (prior_x, prior_y)
        spread_x = math.sqrt(max(squares_x * inverse - x * x, 0.0)) if known else 0.0
        spread_y = math.sqrt(max(squares_y * inverse - y * y, 0.0)) if known else 0.0
        lane_values[MEAN_X * width + lane] = min(max(low_x, x), high_x)
        lane_values[MEAN_Y * width + lane] = min(max(low_y, y), high_y)
        lane_values[SPREAD_X * width + lane] = spread_x
        lane_values[SPREAD_Y * width + lane] = spread_y
        lane_values[SPREAD_XY * width + lane] = products * inverse - x * y if known else 0.0
        lane_values[SPACING * width + lane] = spacing
