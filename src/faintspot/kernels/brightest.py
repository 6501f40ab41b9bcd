"""Brightest-pixel background subtraction and centre of gravity of a group of W images, one in each lane."""

from __future__ import annotations

from typing import Any

from faintspot.kernels.compiling import compiled
from faintspot.kernels.simd import (
    absolute,
    any_lane,
    load,
    maximum,
    minimum,
    multiply_add,
    select,
    splat,
    store,
    width_of,
)

# Rows of the table of per-lane numbers (n_rows, W).
RANK = 0  # in: the threshold is the RANK-th largest pixel
SUBTRACT = 1  # in: 1 to take the threshold off the pixels that stay, 0 to keep them as they are
THRESHOLD = 2  # out
LARGEST = 3  # out: largest magnitude of the image
SUM, X, Y = 4, 5, 6  # out: flux of what stays and its centre of gravity, px from the centre
LANE_ROWS = 7

_COUNTING_PASSES = 24  # enough to tell 256 ordinary pixels apart; ties and outliers go on to the exact passes


@compiled
def _count_above(lanes: Any, image: Any, pixels: Any, threshold: Any) -> Any:
    """Number of pixels above the threshold."""
    width = width_of(lanes)
    zero, one = splat(lanes, 0.0), splat(lanes, 1.0)
    count = zero
    for i in range(pixels):
        count = count + select(load(lanes, image, i * width) > threshold, one, zero)
    return count


@compiled
def _middle(lanes: Any, low: Any, high: Any) -> Any:
    """A number in [low, high), for low < high."""
    half = splat(lanes, 0.5)
    middle = maximum(half * low + half * high, low)
    return select(middle < high, middle, low)


@compiled
def _step_exactly(lanes: Any, image: Any, pixels: Any, rank: Any, low: Any, high: Any) -> Any:
    """Halve the bracket [low, high] of the RANK-th largest pixel; the new ends are pixel values."""
    width = width_of(lanes)
    zero, one = splat(lanes, 0.0), splat(lanes, 1.0)
    middle = _middle(lanes, low, high)
    count, next_above, next_below = zero, high, low
    for i in range(pixels):
        g = load(lanes, image, i * width)
        above = g > middle
        count = count + select(above, one, zero)
        next_above = minimum(select(above, g, next_above), next_above)
        next_below = maximum(select(above, next_below, g), next_below)
    upper = count >= rank
    # With exactly RANK pixels above, the smallest of them is it; with RANK - 1, the largest of the others.
    new_low = select(upper, next_above, select(count >= rank - one, next_below, low))
    new_high = select(upper, select(count > rank, high, next_above), next_below)
    open_lane = low < high
    return select(open_lane, new_low, low), select(open_lane, new_high, high)


@compiled
def find_threshold(lanes: Any, image: Any, pixels: Any, numbers: Any) -> None:
    """Find the RANK-th largest pixel of every lane, exactly, and the largest magnitude.

    Bisection on the value: cheap counting passes narrow the bracket, exact passes snap it to pixel values.
    """
    width = width_of(lanes)
    one = splat(lanes, 1.0)
    rank = load(lanes, numbers, RANK * width)
    low = high = load(lanes, image, 0)
    for i in range(1, pixels):
        g = load(lanes, image, i * width)
        low, high = minimum(g, low), maximum(g, high)
    store(numbers, LARGEST * width, maximum(absolute(low), absolute(high)))
    for _ in range(_COUNTING_PASSES):
        # A lane stops once its middle parts the RANK-th pixel from a neighbour in rank: the next exact
        # pass, at the same middle, then ends the search.
        middle = _middle(lanes, low, high)
        count = _count_above(lanes, image, pixels, middle)
        new_low = select(count > rank, middle, low)
        new_high = select(count < rank - one, middle, high)
        if not any_lane((new_high - new_low) < (high - low)):
            break
        low, high = new_low, new_high
    searching = low < high
    while any_lane(searching):
        low, high = _step_exactly(lanes, image, pixels, rank, low, high)
        searching = low < high
    store(numbers, THRESHOLD * width, low)


@compiled
def subtract_background(lanes: Any, image: Any, pixels: Any, numbers: Any) -> None:
    """Zero the pixels below THRESHOLD in place, and take it off the others where SUBTRACT is 1."""
    width = width_of(lanes)
    zero = splat(lanes, 0.0)
    threshold = load(lanes, numbers, THRESHOLD * width)
    offset = threshold * load(lanes, numbers, SUBTRACT * width)
    for i in range(pixels):
        g = load(lanes, image, i * width)
        store(image, i * width, select(g >= threshold, g - offset, zero))


@compiled
def centre_of_gravity(lanes: Any, image: Any, ny: Any, nx: Any, numbers: Any) -> None:
    """Sum of every lane's image and its centre of gravity; (0, 0) where the sum is not positive."""
    width = width_of(lanes)
    zero, one = splat(lanes, 0.0), splat(lanes, 1.0)
    total, moment_x, moment_y = zero, zero, zero
    for y in range(ny):
        row = zero
        for x in range(nx):
            g = load(lanes, image, (y * nx + x) * width)
            row = row + g
            moment_x = multiply_add(g, splat(lanes, x - 0.5 * (nx - 1)), moment_x)
        total = total + row
        moment_y = multiply_add(row, splat(lanes, y - 0.5 * (ny - 1)), moment_y)
    lit = total > zero
    inverse = one / select(lit, total, one)
    store(numbers, SUM * width, total)
    store(numbers, X * width, select(lit, moment_x * inverse, zero))
    store(numbers, Y * width, select(lit, moment_y * inverse, zero))
