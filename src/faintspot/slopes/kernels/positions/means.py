"""Positions that are means: under a weight that follows the spot, and over the posterior on a grid."""

import math
from typing import Any

from faintspot.base.arrays import Array
from faintspot.slopes.kernels.compiling import compiled
from faintspot.slopes.kernels.groups import Group
from faintspot.slopes.kernels.positions import spot_rows as row
from faintspot.slopes.kernels.positions.brightest import SMALLEST_VARIANCE, relative_variance, variance_of
from faintspot.slopes.kernels.positions.spot_rows import ModelTables, PosteriorTables, SpotScratch, look_up
from faintspot.slopes.kernels.simd import (
    Lanes,
    Vector,
    absolute,
    copy_transposed,
    load,
    maximum,
    minimum,
    multiply_add,
    select,
    splat,
    store,
    sum_of,
    width_of,
)

LEAST_FRACTION = 0.05  # of the flux at the start: less under the weight would only amplify noise


@compiled
def _move(group: Group, image: Array, floor: Vector, own: SpotScratch) -> None:
    """Move every lane by the weighted centre of gravity of its image, seen from where it is."""
    lanes, ny, nx, profiles, lane_values = group.lanes, group.ny, group.nx, own.profiles, own.lane_values
    width, padded = width_of(lanes), profiles.shape[3]
    zero = splat(lanes, 0.0)
    x0, y0 = load(lanes, lane_values, row.X * width), load(lanes, lane_values, row.Y * width)
    total, moment_x, moment_y = zero, zero, zero
    for y in range(ny):
        weight_y = load(lanes, profiles, (2 * padded + y) * width)
        line, line_x = zero, zero
        for x in range(nx):
            weighted = load(lanes, profiles, x * width) * load(lanes, image, (y * nx + x) * width)
            line = line + weighted
            line_x = multiply_add(weighted, splat(lanes, x - 0.5 * (nx - 1)), line_x)
        total = multiply_add(line, weight_y, total)
        moment_x = multiply_add(line_x, weight_y, moment_x)
        moment_y = multiply_add(line * weight_y, splat(lanes, y - 0.5 * (ny - 1)), moment_y)
    inverse = splat(lanes, 1.0) / maximum(total, floor)
    most = load(lanes, lane_values, row.LARGEST_MOVE * width)
    least = zero - most
    dx = load(lanes, lane_values, row.GAIN_X * width) * ((moment_x - x0 * total) * inverse)
    dy = load(lanes, lane_values, row.GAIN_Y * width) * ((moment_y - y0 * total) * inverse)
    dx, dy = minimum(maximum(dx, least), most), minimum(maximum(dy, least), most)
    store(lane_values, row.MOVE_BEFORE * width, load(lanes, lane_values, row.MOVE * width))
    store(lane_values, row.MOVE * width, maximum(absolute(dx), absolute(dy)))
    x0, y0 = x0 + dx, y0 + dy
    low, high = load(lanes, lane_values, row.LOW_X * width), load(lanes, lane_values, row.HIGH_X * width)
    store(lane_values, row.X * width, minimum(maximum(x0, low), high))
    low, high = load(lanes, lane_values, row.LOW_Y * width), load(lanes, lane_values, row.HIGH_Y * width)
    store(lane_values, row.Y * width, minimum(maximum(y0, low), high))


@compiled
def _store_errors(group: Group, image: Array, floor: Vector, own: SpotScratch) -> None:
    """Propagate the pixels' noise, VARIANCE (or `variances`) + EXCESS * g, through the last step."""
    lanes, ny, nx, profiles, lane_values = group.lanes, group.ny, group.nx, own.profiles, own.lane_values
    width, place, padded = width_of(lanes), group.first * ny * nx, profiles.shape[3]
    zero = splat(lanes, 0.0)
    v, e = load(lanes, lane_values, row.VARIANCE * width), load(lanes, lane_values, row.EXCESS * width)
    x0, y0 = load(lanes, lane_values, row.X * width), load(lanes, lane_values, row.Y * width)
    total, noise_x, noise_y, noise_xy, noise, dark_x, dark_y = zero, zero, zero, zero, zero, zero, zero
    for y in range(ny):
        weight_y = load(lanes, profiles, (2 * padded + y) * width)
        away_y = splat(lanes, y - 0.5 * (ny - 1)) - y0
        for x in range(nx):
            weight = weight_y * load(lanes, profiles, x * width)
            at = (y * nx + x) * width
            g = load(lanes, image, at)
            away_x = splat(lanes, x - 0.5 * (nx - 1)) - x0
            total = multiply_add(weight, g, total)
            square = weight * weight
            variance = square * multiply_add(g, e, variance_of(lanes, group.variances, place + at, v))
            noise = noise + variance
            noise_x = multiply_add(variance * away_x, away_x, noise_x)
            noise_y = multiply_add(variance * away_y, away_y, noise_y)
            noise_xy = multiply_add(variance * away_x, away_y, noise_xy)
            dark = square * relative_variance(lanes, group.variances, place + at, v)
            dark_x = multiply_add(dark * away_x, away_x, dark_x)
            dark_y = multiply_add(dark * away_y, away_y, dark_y)
    least = splat(lanes, SMALLEST_VARIANCE)
    illuminated = total > floor
    inverse = splat(lanes, 1.0) / maximum(total, floor)
    gain_x, gain_y = (
        load(lanes, lane_values, row.GAIN_X * width),
        load(lanes, lane_values, row.GAIN_Y * width),
    )
    unknown = splat(lanes, math.inf)
    # Pixels that noise has made negative must not take away more than the flux's own noise.
    noise_x = maximum(noise_x, maximum(v, least) * dark_x)
    noise_y = maximum(noise_y, maximum(v, least) * dark_y)
    error_x = gain_x * gain_x * inverse * inverse * noise_x
    error_y = gain_y * gain_y * inverse * inverse * noise_y
    store(lane_values, row.ERROR_X * width, select(illuminated, error_x, unknown))
    store(lane_values, row.ERROR_Y * width, select(illuminated, error_y, unknown))
    store(lane_values, row.COVARIANCE * width, gain_x * gain_y * inverse * inverse * noise_xy)
    store(lane_values, row.SEEN * width, total)
    store(lane_values, row.SEEN_ERROR * width, maximum(noise, least))
    for lane in range(width):
        lane_values[row.SEEN_ERROR * width + lane] = math.sqrt(lane_values[row.SEEN_ERROR * width + lane])
        for error in (row.ERROR_X, row.ERROR_Y):
            lane_values[error * width + lane] = math.sqrt(max(lane_values[error * width + lane], 0.0))


@compiled
def weigh_group(group: Group, tables: ModelTables, image: Array, own: SpotScratch) -> None:
    """Follow the W spots of a group with a weight; parameters as `likelihood.fit_group`.

    The tables hold the weight's profile, 1 at its centre.
    """
    flux = load(group.lanes, own.lane_values, row.FLUX * width_of(group.lanes))
    floor = splat(group.lanes, LEAST_FRACTION) * flux
    for _ in range(tables.steps):
        look_up(group, tables.model, own)
        _move(group, image, floor, own)
    _store_errors(group, image, floor, own)


@compiled
def rows_from_lanes(lanes: Lanes, image: Array, ny: int, nx: int, starts: Array, rows: Array) -> None:
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
def _share(position: float, spacing: float, low: float, high: float) -> float:
    """Return the fraction of a grid point's cell within the allowed positions."""
    return min(position + 0.5 * spacing, high) - max(position - 0.5 * spacing, low)


@compiled
def _log_likelihood(lanes: Lanes, rows: Array, lane: int, tables: Any, table: int, position: int) -> float:
    """Return the sum of the image times the table of a position."""
    width = width_of(lanes)
    count = rows.shape[0] * rows.shape[1]
    at = (table * tables.shape[1] + position) * count * width
    # Two sums: the next multiplication need not wait for the last.
    even, odd = splat(lanes, 0.0), splat(lanes, 0.0)
    for y in range(0, count - 1, 2):
        g = load(lanes, rows, (y * width + lane) * width)
        even = multiply_add(g, load(lanes, tables, at + y * width), even)
        g = load(lanes, rows, ((y + 1) * width + lane) * width)
        odd = multiply_add(g, load(lanes, tables, at + (y + 1) * width), odd)
    if count % 2 == 1:
        g = load(lanes, rows, ((count - 1) * width + lane) * width)
        even = multiply_add(g, load(lanes, tables, at + (count - 1) * width), even)
    return float(sum_of(even + odd))


@compiled
def posterior_of_group(group: Group, tables: PosteriorTables, image: Array, own: SpotScratch) -> None:
    """Write mean, standard deviation and covariance of the posterior of the W spots of a group.

    Parameters
    ----------
    group : Group
    tables : PosteriorTables
    image : (>= ny * nx * W + W,)
    own : SpotScratch
        In its rows, allowed positions and prior are read.
    """
    lanes, lane_values, rows, values = group.lanes, own.lane_values, own.rows, own.logarithms
    constants, grid, spacing, which = tables.constants, tables.grid, tables.spacing, own.kinds
    width = width_of(lanes)
    n = grid.shape[0]
    rows_from_lanes(lanes, image, group.ny, group.nx, own.starts, rows)
    for lane in range(width):
        low_x, high_x = lane_values[row.LOW_X * width + lane], lane_values[row.HIGH_X * width + lane]
        low_y, high_y = lane_values[row.LOW_Y * width + lane], lane_values[row.HIGH_Y * width + lane]
        prior = float(lane_values[row.PRIOR_WEIGHT * width + lane])
        prior_x, prior_y = (
            float(lane_values[row.PRIOR_X * width + lane]),
            float(lane_values[row.PRIOR_Y * width + lane]),
        )
        largest = -math.inf
        for i in range(n):
            x, y = float(grid[i, 0]), float(grid[i, 1])
            share_x, share_y = _share(x, spacing, low_x, high_x), _share(y, spacing, low_y, high_y)
            values[i] = -math.inf
            away_x, away_y = (x - prior_x) ** 2 * prior, (y - prior_y) ** 2 * prior
            if share_x > 0.0 and share_y > 0.0 and max(away_x, away_y) <= REACH * REACH:
                value = _log_likelihood(lanes, rows, lane, tables.logarithms, which[lane], i)
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
        lane_values[row.MEAN_X * width + lane] = min(max(low_x, x), high_x)
        lane_values[row.MEAN_Y * width + lane] = min(max(low_y, y), high_y)
        lane_values[row.SPREAD_X * width + lane] = spread_x
        lane_values[row.SPREAD_Y * width + lane] = spread_y
        lane_values[row.SPREAD_XY * width + lane] = products * inverse - x * y if known else 0.0
        lane_values[row.SPACING * width + lane] = spacing
