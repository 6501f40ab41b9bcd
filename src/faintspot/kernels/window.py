"""Slopes that are linear in the pixels: the own kernel of fixed windows and other fixed weights."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from faintspot.kernels import groups
from faintspot.kernels.compiling import compiled
from faintspot.kernels.groups import COMMON_ROWS, NO_LIGHT, TOO_MANY_BAD_PIXELS, driver_of
from faintspot.kernels.simd import Lanes, load, multiply_add, splat, store, width_of

# Rows of the settings' table that follow the common ones: what the sums are divided by (0: the frame's own
# light; negative: not measurable); position of a sum of 0; what a light of 1 e- at the reference adds to the
# sums; variance of the sums in the dark and for a light of 1 e-; the same of the light under the weights.
DIVISOR, HOME_X, HOME_Y, OFFSET_X, OFFSET_Y = range(COMMON_ROWS, COMMON_ROWS + 5)
DARK_X, DARK_Y, PHOTON_X, PHOTON_Y, DARK_LIGHT, PHOTON_LIGHT = range(COMMON_ROWS + 5, COMMON_ROWS + 11)
SETTING_ROWS = COMMON_ROWS + 11

X, Y, LIGHT = range(3)
"""Which weights, of those of a pixel."""
LEAST_SIGNIFICANCE = 1.0
"""Light of a frame that is less significant than this many standard deviations divides nothing."""


class WindowTables(NamedTuple):
    """What the kernel reads beside the settings."""

    weights: Any
    """(n_groups, rows, columns, 3, W) float32: of the pixels that count."""
    top: Any
    """First row of those."""
    left: Any
    rows: Any
    columns: Any


def no_scratch(lanes: Lanes, ny: int, nx: int) -> tuple[Any, ...]:
    """Return the kernel's own memory: none."""
    return ()


@compiled
def locate_window(group: Any, tables: Any, scratch: Any, stages: Any) -> None:
    """Sum the images of a group under their weights."""
    lanes, nx, image, found = group.lanes, group.nx, scratch.image, scratch.results
    width = width_of(lanes)
    zero = splat(lanes, 0.0)
    sum_x, sum_y, light = zero, zero, zero
    place = group.first * tables.rows * tables.columns * 3
    for y in range(tables.top, tables.top + tables.rows):
        row_x, row_y, row = zero, zero, zero  # a sum for each row: they need not wait for each other
        for x in range(tables.left, tables.left + tables.columns):
            g = load(lanes, image, (y * nx + x) * width)
            row_x = multiply_add(g, load(lanes, tables.weights, place + X * width), row_x)
            row_y = multiply_add(g, load(lanes, tables.weights, place + Y * width), row_y)
            row = multiply_add(g, load(lanes, tables.weights, place + LIGHT * width), row)
            place += 3 * width
        sum_x, sum_y, light = sum_x + row_x, sum_y + row_y, light + row
    store(found, groups.X * width, sum_x)
    store(found, groups.Y * width, sum_y)
    store(found, groups.FLUX * width, light)
    for lane in range(width):
        _finish(width, lane, group, scratch)


@compiled
def _finish(width: Any, lane: Any, group: Any, scratch: Any) -> None:
    """Turn one lane's sums into a position, its standard errors and flags."""
    settings, found = group.settings, scratch.results
    s = min(group.first + lane, settings.shape[1] - 1)
    seen = found[groups.FLUX * width + lane]
    divisor = settings[DIVISOR, s]
    usable = divisor > 0.0
    if divisor == 0.0:
        variance = settings[DARK_LIGHT, s] + settings[PHOTON_LIGHT, s] * max(seen, 0.0)
        usable = seen > LEAST_SIGNIFICANCE * math.sqrt(variance)
        divisor = seen
    total = abs(found[groups.X * width + lane]) + abs(found[groups.Y * width + lane]) + abs(seen)
    usable = usable and total < math.inf  # False for NaN, too
    inverse = 1.0 / divisor if usable else 0.0
    light = max(seen, 0.0) if settings[DIVISOR, s] == 0.0 else divisor
    for axis in range(2):
        moved = found[(groups.X + axis) * width + lane] * inverse - settings[OFFSET_X + axis, s]
        variance = settings[DARK_X + axis, s] + settings[PHOTON_X + axis, s] * light
        error = math.sqrt(variance) * inverse
        usable = usable and abs(moved) + error < math.inf
        found[(groups.X + axis) * width + lane] = settings[HOME_X + axis, s] + moved
        found[(groups.ERROR_X + axis) * width + lane] = error
    found[groups.FLUX * width + lane] = seen if abs(seen) < math.inf else 0.0
    if not usable and not scratch.flags[lane] & TOO_MANY_BAD_PIXELS:
        scratch.flags[lane] |= NO_LIGHT
    scratch.iterations[lane] = 0


window_of_groups = driver_of(locate_window)
