"""Slopes that are linear in the pixels: fixed windows and other fixed weights.

Where the pixels that count are rows of whole vectors, they are taken straight from the frame, and the
calibration is part of the weights: to gather whole windows would take several times longer than the sums.
What has bad pixels is left to `locate_window`.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from faintspot.base.arrays import Array
from faintspot.base.checks import LARGEST_FLOAT32
from faintspot.slopes.kernels import groups
from faintspot.slopes.kernels.compiling import compiled
from faintspot.slopes.kernels.gather import pixels_of
from faintspot.slopes.kernels.groups import (
    COMMON_ROWS,
    NO_FLUX,
    SATURATED,
    TOO_MANY_BAD_PIXELS,
    Group,
    Scratch,
    SlopeArrays,
    Source,
    Task,
    driver_of,
    place_of,
    store_covariance,
    store_slope,
)
from faintspot.slopes.kernels.host import flush_subnormals, restore_control
from faintspot.slopes.kernels.simd import (
    Lanes,
    absolute,
    any_lane,
    load,
    maximum,
    multiply_add,
    select,
    splat,
    store,
    sum_of,
    width_of,
)

# Rows of the settings' table that follow the common ones: what the sums are divided by (0: the frame's own
# flux; negative: not measurable); position of a sum of 0; what a flux of 1 e- at the reference adds to the
# sums; variance of the sums in the dark and for a flux of 1 e-; the same of the flux under the weights;
# covariance of the sums.
DIVISOR, HOME_X, HOME_Y, OFFSET_X, OFFSET_Y = range(COMMON_ROWS, COMMON_ROWS + 5)
DARK_X, DARK_Y, PHOTON_X, PHOTON_Y, DARK_FLUX, PHOTON_FLUX = range(COMMON_ROWS + 5, COMMON_ROWS + 11)
DARK_XY, PHOTON_XY = range(COMMON_ROWS + 11, COMMON_ROWS + 13)
SETTING_ROWS = COMMON_ROWS + 13

X, Y, FLUX = range(3)
"""Indices of the weights of a pixel."""
LEAST_SIGNIFICANCE = 1.0
"""Flux of a frame that is less significant than this many standard deviations divides nothing."""


class WindowTables(NamedTuple):
    """Tables that the kernel reads in addition to the settings."""

    weights: Array
    """(n_groups, rows, columns, 3, W) float32: of the pixels that count."""
    top: int
    """First row of those."""
    left: int
    rows: int
    columns: int


class RowTables(NamedTuple):
    """The same, of pixels that lie side by side in the frame."""

    pixels: Lanes
    """Lanes: of pixels in a row."""
    weights: Array
    """(n_subapertures, rows, vectors, 3, W) float32: for pixels in ADU; 0 in those that do not count."""
    level: Array
    """(n_subapertures,) float32: taken off every pixel first, so that nothing is lost in large sums."""
    dark: Array
    """(n_subapertures, 3) float32: sums that the dark gives above the level."""
    bad: Array
    """(n_subapertures,) bool: whether a pixel that counts is masked."""
    top: int
    left: int
    gathered: WindowTables
    """WindowTables, for groups with bad pixels."""


def no_scratch(lanes: Lanes, ny: int, nx: int) -> tuple[Any, ...]:
    """Return the kernel's own memory: none."""
    return ()


@compiled
def locate_window(group: Group, tables: WindowTables, scratch: Scratch, stages: Array) -> None:
    """Sum the images of a group under their weights."""
    lanes, nx, image, found = group.lanes, group.nx, scratch.image, scratch.results
    width = width_of(lanes)
    zero = splat(lanes, 0.0)
    sum_x, sum_y, flux = zero, zero, zero
    place = group.first * tables.rows * tables.columns * 3
    for y in range(tables.top, tables.top + tables.rows):
        row_x, row_y, row = zero, zero, zero  # a sum for each row: they need not wait for each other
        for x in range(tables.left, tables.left + tables.columns):
            g = load(lanes, image, (y * nx + x) * width)
            row_x = multiply_add(g, load(lanes, tables.weights, place + X * width), row_x)
            row_y = multiply_add(g, load(lanes, tables.weights, place + Y * width), row_y)
            row = multiply_add(g, load(lanes, tables.weights, place + FLUX * width), row)
            place += 3 * width
        sum_x, sum_y, flux = sum_x + row_x, sum_y + row_y, flux + row
    store(found, groups.X * width, sum_x)
    store(found, groups.Y * width, sum_y)
    store(found, groups.FLUX * width, flux)
    for lane in range(width):
        s = min(group.first + lane, group.settings.shape[1] - 1)
        x, y, seen, error_x, error_y, covariance, usable = _solved(
            group.settings,
            s,
            found[groups.X * width + lane],
            found[groups.Y * width + lane],
            found[groups.FLUX * width + lane],
        )
        found[groups.X * width + lane], found[groups.Y * width + lane] = x, y
        found[groups.FLUX * width + lane] = seen
        found[groups.ERROR_X * width + lane], found[groups.ERROR_Y * width + lane] = error_x, error_y
        found[groups.COVARIANCE * width + lane] = covariance
        if not usable and not scratch.flags[lane] & TOO_MANY_BAD_PIXELS:
            scratch.flags[lane] |= NO_FLUX
        scratch.iterations[lane] = 0


@compiled
def _solved(settings: Array, s: int, sum_x: float, sum_y: float, seen: float) -> Any:
    """Return position, flux, standard errors, covariance, and whether they are good for anything."""
    divisor = settings[DIVISOR, s]
    flux = divisor
    usable = divisor > 0.0
    if divisor == 0.0:
        flux = max(seen, np.float32(0.0))
        variance = settings[DARK_FLUX, s] + settings[PHOTON_FLUX, s] * flux
        usable = seen > LEAST_SIGNIFICANCE * math.sqrt(variance)
        divisor = seen
    usable = usable and abs(sum_x) + abs(sum_y) + abs(seen) < math.inf  # False for NaN, too
    inverse = np.float32(1.0) / divisor if usable else np.float32(0.0)
    x = settings[HOME_X, s] + (sum_x * inverse - settings[OFFSET_X, s])
    y = settings[HOME_Y, s] + (sum_y * inverse - settings[OFFSET_Y, s])
    error_x = math.sqrt(settings[DARK_X, s] + settings[PHOTON_X, s] * flux) * inverse
    error_y = math.sqrt(settings[DARK_Y, s] + settings[PHOTON_Y, s] * flux) * inverse
    covariance = (settings[DARK_XY, s] + settings[PHOTON_XY, s] * flux) * (inverse * inverse)
    usable = usable and abs(x) + abs(y) + error_x + error_y < math.inf
    return x, y, seen if abs(seen) < math.inf else np.float32(0.0), error_x, error_y, covariance, usable


window_of_groups = driver_of(locate_window)


@compiled
def _measure(source: Source, tables: RowTables, f: int, s: int, settings: Array, slopes: SlopeArrays) -> bool:
    """Measure one sub-aperture; False, and nothing written, where a pixel that counts is bad."""
    if tables.bad[s]:
        return False
    frames, corners, pixels = source.frames, source.corners, tables.pixels
    width = width_of(pixels)
    height, line = frames.counts.shape[1], frames.counts.shape[2]
    rows, vectors = tables.weights.shape[1], tables.weights.shape[2]
    corner = (corners[s, 0] + tables.top) * line + corners[s, 1] + tables.left
    zero = splat(pixels, 0.0)
    sum_x, sum_y, flux, spoilt, largest, brightest = zero, zero, zero, zero, zero, splat(pixels, -math.inf)
    level = splat(pixels, tables.level[s])
    place = s * rows * vectors * 3 * width
    for y in range(rows):
        for vector in range(vectors):
            raw = pixels_of(pixels, frames, f * height * line + corner + y * line + vector * width)
            brightest = maximum(raw, brightest)
            g = raw - level
            largest = maximum(absolute(g), largest)
            spoilt = multiply_add(g, zero, spoilt)  # 0, or NaN where a value is not finite
            sum_x = multiply_add(g, load(pixels, tables.weights, place + X * width), sum_x)
            sum_y = multiply_add(g, load(pixels, tables.weights, place + Y * width), sum_y)
            flux = multiply_add(g, load(pixels, tables.weights, place + FLUX * width), flux)
            place += 3 * width
    one = splat(pixels, 1.0)
    bad = select(spoilt >= zero, select(largest <= splat(pixels, LARGEST_FLOAT32), zero, one), one)
    if any_lane(bad > zero):
        return False
    dark = tables.dark[s]
    x, y, seen, error_x, error_y, covariance, usable = _solved(
        settings, s, sum_of(sum_x) - dark[X], sum_of(sum_y) - dark[Y], sum_of(flux) - dark[FLUX]
    )
    bits = SATURATED if any_lane(brightest >= splat(pixels, source.saturation)) else 0
    bits |= 0 if usable else NO_FLUX
    store_slope(f, s, settings, x, y, seen, error_x, error_y, bits, 0, 0, slopes)
    store_covariance(f, s, settings, covariance, slopes)
    return True


@compiled
def window_in_rows(
    source: Source, task: Task, start: int, stop: int, scratch: Scratch, slopes: SlopeArrays, stages: Array
) -> None:
    """Compute the slopes of the groups [start, stop) of a block of frames; see `groups.measure_groups`."""
    width, n = width_of(source.lanes), source.corners.shape[0]
    control = flush_subnormals()
    for item in range(start, stop):
        f, first = place_of(source, item)
        last = min(first + width, n)
        settings = task.settings[task.variants[f]]
        whole = stages.shape[0] == 0
        for s in range(first, last):
            whole = _measure(source, task.tables, f, s, settings, slopes) and whole
        if whole:
            continue
        filled = Task(task.settings, task.variants, task.prior, task.tables.gathered, task.variances)
        window_of_groups(source, filled, item, item + 1, scratch, slopes, stages)
        for s in range(first, last):  # those without bad pixels once more: slopes depend on no neighbour
            _measure(source, task.tables, f, s, settings, slopes)
    restore_control(control)
