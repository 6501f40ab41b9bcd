"""Centres of gravity above a threshold, straight from the frame: one pass, W pixels of a row at once.

No pixel waits for another here, so that nothing is copied and put side by side as for the denoiser. What has
bad pixels is left to `gravity`, which fills them.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from faintspot.base.checks import LARGEST_FLOAT32
from faintspot.slopes.kernels.compilation.compiling import compiled
from faintspot.slopes.kernels.compilation.simd import (
    absolute,
    any_lane,
    largest_of,
    load,
    maximum,
    multiply_add,
    select,
    splat,
    sum_of,
    widened,
    width_of,
)
from faintspot.slopes.kernels.driver.groups import EXCESS, SATURATED, VARIANCE, store_covariance, store_slope
from faintspot.slopes.kernels.driver.row_driver import rows_driver_of
from faintspot.slopes.kernels.gravity.gravity import FLOOR, LEVEL, gravity_of_groups, lightless
from faintspot.slopes.kernels.gravity.pixel_noise import variance_of

_WITHIN = 1.0 / 12.0  # of the flux in a pixel, where in it is not known: px^2


class RowTables(NamedTuple):
    """Tables that the kernel reads in addition to the settings."""

    pixels: Any
    """Lanes: of pixels in a row; their number divides nx."""
    maps: Any
    """(2, h, w) float32: dark and scale of every pixel of the frame."""
    ramp: Any
    """(nx,) float32: positions of a window's columns, px from its middle."""
    gathered: Any
    """GravityTables, for groups with bad pixels."""
    variances: Any
    """(h, w) float32: variance of each pixel of the frame in the dark [e-^2]; None: that of the settings."""


@compiled
def _measure(source: Any, tables: Any, f: Any, s: Any, settings: Any, slopes: Any) -> Any:
    """Measure one sub-aperture; False, and nothing written, where it has bad pixels."""
    frames, ny, nx, corners = source.frames, source.ny, source.nx, source.corners
    pixels, maps, ramp = tables.pixels, tables.maps, tables.ramp
    width = width_of(pixels)
    height, line = frames.shape[1], frames.shape[2]
    corner = corners[s, 0] * line + corners[s, 1]
    zero, threshold = splat(pixels, 0.0), splat(pixels, settings[LEVEL, s])
    v, e = splat(pixels, settings[VARIANCE, s]), splat(pixels, settings[EXCESS, s])
    one = splat(pixels, 1.0)
    spoilt, brightest, largest = zero, splat(pixels, -math.inf), zero
    total, moment_x, moment_y = zero, zero, zero
    noise, noise_x, noise_xx, noise_y, noise_yy, noise_xy = zero, zero, zero, zero, zero, zero
    for x in range(0, nx, width):
        column = load(pixels, ramp, x)
        flux, flux_y, part, part_y, part_yy = zero, zero, zero, zero, zero
        row = splat(pixels, -0.5 * (ny - 1))
        for y in range(ny):
            here = corner + y * line + x
            raw = widened(pixels, frames, f * height * line + here)
            value = (raw - load(pixels, maps, here)) * load(pixels, maps, height * line + here)
            brightest = maximum(raw, brightest)
            largest = maximum(absolute(value), largest)
            spoilt = multiply_add(value, zero, spoilt)  # 0, or NaN where a value is not finite
            left = select(value >= threshold, value - threshold, zero)
            flux = flux + left
            flux_y = multiply_add(left, row, flux_y)
            own = variance_of(pixels, tables.variances, here, v)
            variance = select(left > zero, multiply_add(maximum(value, zero), e, own), zero)
            part = part + variance
            variance_y = variance * row
            part_y = part_y + variance_y
            part_yy = multiply_add(variance_y, row, part_yy)
            row = row + one
        total, moment_y = total + flux, moment_y + flux_y
        moment_x = multiply_add(flux, column, moment_x)
        noise, noise_y, noise_yy = noise + part, noise_y + part_y, noise_yy + part_yy
        part_x = part * column
        noise_x = noise_x + part_x
        noise_xx = multiply_add(part_x, column, noise_xx)
        noise_xy = multiply_add(part_y, column, noise_xy)
    good = select(spoilt >= zero, select(largest <= splat(pixels, LARGEST_FLOAT32), zero, one), one)
    if any_lane(good > zero):
        return False
    flux = sum_of(total)
    position_x = position_y = deviation_x = deviation_y = covariance = np.float32(0.0)
    if flux > 0.0:
        scale = np.float32(1.0) / flux
        position_x, position_y = sum_of(moment_x) * scale, sum_of(moment_y) * scale
        # Second moments about the centre of gravity, from those about the window's middle.
        here = splat(pixels, -2.0 * position_x)
        around = multiply_add(noise_x, here, noise_xx)
        around = multiply_add(noise, splat(pixels, position_x * position_x + _WITHIN), around)
        deviation_x = _root(sum_of(around)) * scale
        here = splat(pixels, -2.0 * position_y)
        around = multiply_add(noise_y, here, noise_yy)
        around = multiply_add(noise, splat(pixels, position_y * position_y + _WITHIN), around)
        deviation_y = _root(sum_of(around)) * scale
        around = multiply_add(noise_x, splat(pixels, -position_y), noise_xy)
        around = multiply_add(noise_y, splat(pixels, -position_x), around)
        around = multiply_add(noise, splat(pixels, position_x * position_y), around)
        covariance = sum_of(around) * scale * scale
    bits = SATURATED if any_lane(brightest >= splat(pixels, source.saturation)) else 0
    bits |= lightless(ny, nx, bits, flux, settings[FLOOR, s] * largest_of(largest), position_x, position_y)
    slopes.iterations[f, s] = slopes.bad_pixels[f, s] = 0
    slopes.flux[f, s] = flux
    store_slope(f, s, settings, position_x, position_y, deviation_x, deviation_y, bits, slopes)
    store_covariance(f, s, settings, covariance, slopes)
    return True


@compiled
def _root(square: Any) -> Any:
    """Square root of what round-off may have left below 0."""
    return math.sqrt(max(square, np.float32(0.0)))


thresholded_in_rows = rows_driver_of(_measure, gravity_of_groups)
