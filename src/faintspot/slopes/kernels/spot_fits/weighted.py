"""Centre of gravity under a weight that follows the spot (iteratively weighted centre of gravity)."""

from __future__ import annotations

import math
from typing import Any

from faintspot.slopes.kernels.compilation.compiling import compiled
from faintspot.slopes.kernels.compilation.simd import (
    absolute,
    load,
    maximum,
    minimum,
    multiply_add,
    select,
    splat,
    store,
    width_of,
)
from faintspot.slopes.kernels.gravity.smoothing import SMALLEST_VARIANCE, relative_variance, variance_of
from faintspot.slopes.kernels.spot_fits.profiles import look_up
from faintspot.slopes.kernels.spot_fits.spot_rows import (
    COVARIANCE,
    ERROR_X,
    ERROR_Y,
    EXCESS,
    FLUX,
    GAIN_X,
    GAIN_Y,
    HIGH_X,
    HIGH_Y,
    LARGEST_MOVE,
    LOW_X,
    LOW_Y,
    MOVE,
    MOVE_BEFORE,
    SEEN,
    SEEN_ERROR,
    VARIANCE,
    X,
    Y,
)

LEAST_FRACTION = 0.05  # of the flux at the start: less under the weight would only amplify noise


@compiled
def _move(lanes: Any, image: Any, ny: Any, nx: Any, profiles: Any, floor: Any, lane_values: Any) -> None:
    """Move every lane by the weighted centre of gravity of its image, seen from where it is."""
    width = width_of(lanes)
    padded = profiles.shape[3]
    zero = splat(lanes, 0.0)
    x0, y0 = load(lanes, lane_values, X * width), load(lanes, lane_values, Y * width)
    total, moment_x, moment_y = zero, zero, zero
    for y in range(ny):
        weight_y = load(lanes, profiles, (2 * padded + y) * width)
        row, row_x = zero, zero
        for x in range(nx):
            weighted = load(lanes, profiles, x * width) * load(lanes, image, (y * nx + x) * width)
            row = row + weighted
            row_x = multiply_add(weighted, splat(lanes, x - 0.5 * (nx - 1)), row_x)
        total = multiply_add(row, weight_y, total)
        moment_x = multiply_add(row_x, weight_y, moment_x)
        moment_y = multiply_add(row * weight_y, splat(lanes, y - 0.5 * (ny - 1)), moment_y)
    inverse = splat(lanes, 1.0) / maximum(total, floor)
    most = load(lanes, lane_values, LARGEST_MOVE * width)
    least = zero - most
    dx = load(lanes, lane_values, GAIN_X * width) * ((moment_x - x0 * total) * inverse)
    dy = load(lanes, lane_values, GAIN_Y * width) * ((moment_y - y0 * total) * inverse)
    dx, dy = minimum(maximum(dx, least), most), minimum(maximum(dy, least), most)
    store(lane_values, MOVE_BEFORE * width, load(lanes, lane_values, MOVE * width))
    store(lane_values, MOVE * width, maximum(absolute(dx), absolute(dy)))
    x0, y0 = x0 + dx, y0 + dy
    low, high = load(lanes, lane_values, LOW_X * width), load(lanes, lane_values, HIGH_X * width)
    store(lane_values, X * width, minimum(maximum(x0, low), high))
    low, high = load(lanes, lane_values, LOW_Y * width), load(lanes, lane_values, HIGH_Y * width)
    store(lane_values, Y * width, minimum(maximum(y0, low), high))


@compiled
def _store_errors(
    lanes: Any,
    image: Any,
    variances: Any,
    place: Any,
    ny: Any,
    nx: Any,
    profiles: Any,
    floor: Any,
    lane_values: Any,
) -> None:
    """Propagate the pixels' noise, VARIANCE (or `variances`) + EXCESS * g, through the last step."""
    width = width_of(lanes)
    padded = profiles.shape[3]
    zero = splat(lanes, 0.0)
    v, e = load(lanes, lane_values, VARIANCE * width), load(lanes, lane_values, EXCESS * width)
    x0, y0 = load(lanes, lane_values, X * width), load(lanes, lane_values, Y * width)
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
            variance = square * multiply_add(g, e, variance_of(lanes, variances, place + at, v))
            noise = noise + variance
            noise_x = multiply_add(variance * away_x, away_x, noise_x)
            noise_y = multiply_add(variance * away_y, away_y, noise_y)
            noise_xy = multiply_add(variance * away_x, away_y, noise_xy)
            dark = square * relative_variance(lanes, variances, place + at, v)
            dark_x = multiply_add(dark * away_x, away_x, dark_x)
            dark_y = multiply_add(dark * away_y, away_y, dark_y)
    least = splat(lanes, SMALLEST_VARIANCE)
    illuminated = total > floor
    inverse = splat(lanes, 1.0) / maximum(total, floor)
    gain_x, gain_y = load(lanes, lane_values, GAIN_X * width), load(lanes, lane_values, GAIN_Y * width)
    unknown = splat(lanes, math.inf)
    # Pixels that noise has made negative must not take away more than the flux's own noise.
    noise_x = maximum(noise_x, maximum(v, least) * dark_x)
    noise_y = maximum(noise_y, maximum(v, least) * dark_y)
    error_x = gain_x * gain_x * inverse * inverse * noise_x
    error_y = gain_y * gain_y * inverse * inverse * noise_y
    store(lane_values, ERROR_X * width, select(illuminated, error_x, unknown))
    store(lane_values, ERROR_Y * width, select(illuminated, error_y, unknown))
    store(lane_values, COVARIANCE * width, gain_x * gain_y * inverse * inverse * noise_xy)
    store(lane_values, SEEN * width, total)
    store(lane_values, SEEN_ERROR * width, maximum(noise, least))
    for lane in range(width):
        lane_values[SEEN_ERROR * width + lane] = math.sqrt(lane_values[SEEN_ERROR * width + lane])
        for row in (ERROR_X, ERROR_Y):
            lane_values[row * width + lane] = math.sqrt(max(lane_values[row * width + lane], 0.0))


@compiled
def weigh_group(
    lanes: Any,
    image: Any,
    variances: Any,
    place: Any,
    ny: Any,
    nx: Any,
    tables: Any,
    which: Any,
    steps: Any,
    lane_values: Any,
    starts: Any,
    profiles: Any,
) -> None:
    """Follow the W spots of a group with a weight; parameters as `likelihood.fit_group`.

    The tables hold the weight's profile, 1 at its centre.
    """
    width = width_of(lanes)
    floor = splat(lanes, LEAST_FRACTION) * load(lanes, lane_values, FLUX * width)
    for _ in range(steps):
        look_up(lanes, tables, which, ny, nx, lane_values, starts, profiles)
        _move(lanes, image, ny, nx, profiles, floor, lane_values)
    _store_errors(lanes, image, variances, place, ny, nx, profiles, floor, lane_values)
