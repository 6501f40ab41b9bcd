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
    square_root,
    store,
    width_of,
)

# Rows of the table of per-lane numbers (n_rows, W).
RANK = 0  # in: the threshold is the RANK-th largest pixel
SUBTRACT = 1  # in: 1 to take the threshold off the pixels that stay, 0 to keep them as they are
THRESHOLD = 2  # out
LARGEST = 3  # out: largest magnitude of the image
SUM, X, Y = 4, 5, 6  # out: flux of what stays and its centre of gravity, px from the centre
VARIANCE, EXCESS = 7, 8  # in: variance of a pixel that collects m electrons, VARIANCE + EXCESS m
ERROR_X, ERROR_Y = 9, 10  # out: standard error of the centre of gravity, px
LANE_ROWS = 11

_COUNTING_PASSES = 24  # usually 6 to 10 are enough; ties and outliers go on to the exact passes


@compiled
def _sum_above(lanes: Any, image: Any, pixels: Any, threshold: Any) -> Any:
    """Number and sum of the pixels above the threshold."""
    width = width_of(lanes)
    zero, one = splat(lanes, 0.0), splat(lanes, 1.0)
    count, total = zero, zero
    for i in range(pixels):
        g = load(lanes, image, i * width)
        above = g > threshold
        count = count + select(above, one, zero)
        total = total + select(above, g, zero)
    return count, total


@compiled
def _pivot(lanes: Any, low: Any, high: Any, wanted: Any) -> Any:
    """The wanted number if it is in [low, high), for low < high; else one in their middle."""
    half = splat(lanes, 0.5)
    middle = maximum(half * low + half * high, low)
    middle = select(middle < high, middle, low)
    return select(wanted >= low, select(wanted < high, wanted, middle), middle)


@compiled
def _step_exactly(lanes: Any, image: Any, pixels: Any, rank: Any, low: Any, high: Any, pivot: Any) -> Any:
    """Narrow the bracket [low, high] of the RANK-th largest pixel at a pivot; new ends are pixel values."""
    width = width_of(lanes)
    zero, one = splat(lanes, 0.0), splat(lanes, 1.0)
    count, next_above, next_below = zero, high, low
    for i in range(pixels):
        g = load(lanes, image, i * width)
        above = g > pivot
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

    As quickselect does, but without moving pixels: count those above a pivot, the mean of the pixels that
    are still in question. Once the pivot parts the RANK-th pixel from a neighbour in rank, one exact pass
    finds its value.
    """
    width = width_of(lanes)
    one, zero = splat(lanes, 1.0), splat(lanes, 0.0)
    rank = load(lanes, numbers, RANK * width)
    low = high = load(lanes, image, 0)
    low_sum = zero
    for i in range(pixels):
        g = load(lanes, image, i * width)
        low, high = minimum(g, low), maximum(g, high)
        low_sum = low_sum + g
    store(numbers, LARGEST * width, maximum(absolute(low), absolute(high)))
    low_count, high_count, high_sum = splat(lanes, pixels), zero, zero
    pivot = low
    for _ in range(_COUNTING_PASSES):
        between = maximum(low_count - high_count, one)
        pivot = _pivot(lanes, low, high, (low_sum - high_sum) / between)
        count, total = _sum_above(lanes, image, pixels, pivot)
        up, down = count > rank, count < rank - one
        new_low, new_high = select(up, pivot, low), select(down, pivot, high)
        low_count, low_sum = select(up, count, low_count), select(up, total, low_sum)
        high_count, high_sum = select(down, count, high_count), select(down, total, high_sum)
        narrowed = any_lane((new_high - new_low) < (high - low))
        low, high = new_low, new_high
        if not narrowed:
            break
    while any_lane(low < high):
        low, high = _step_exactly(lanes, image, pixels, rank, low, high, _pivot(lanes, low, high, pivot))
    store(numbers, THRESHOLD * width, low)


@compiled
def find_largest(lanes: Any, image: Any, pixels: Any, numbers: Any) -> None:
    """Find the largest magnitude of every lane."""
    width = width_of(lanes)
    largest = splat(lanes, 0.0)
    for i in range(pixels):
        largest = maximum(absolute(load(lanes, image, i * width)), largest)
    store(numbers, LARGEST * width, largest)


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


@compiled
def noise_of_centroid(lanes: Any, image: Any, left: Any, ny: Any, nx: Any, numbers: Any) -> None:
    """Propagate the noise of the pixels that are left to the centre of gravity: VARIANCE + EXCESS max(g, 0).

    `image` holds the pixels g as they were measured, `left` what is left of them.
    """
    width = width_of(lanes)
    zero, one = splat(lanes, 0.0), splat(lanes, 1.0)
    v, e = load(lanes, numbers, VARIANCE * width), load(lanes, numbers, EXCESS * width)
    x0, y0 = load(lanes, numbers, X * width), load(lanes, numbers, Y * width)
    noise_x, noise_y = zero, zero
    within = splat(lanes, 1.0 / 12.0)  # of the light in a pixel, where in it is not known: px^2
    for y in range(ny):
        away_y = splat(lanes, y - 0.5 * (ny - 1)) - y0
        for x in range(nx):
            here = (y * nx + x) * width
            variance = multiply_add(maximum(load(lanes, image, here), zero), e, v)
            variance = select(load(lanes, left, here) > zero, variance, zero)
            away_x = splat(lanes, x - 0.5 * (nx - 1)) - x0
            noise_x = multiply_add(variance, multiply_add(away_x, away_x, within), noise_x)
            noise_y = multiply_add(variance, multiply_add(away_y, away_y, within), noise_y)
    total = load(lanes, numbers, SUM * width)
    lit = total > zero
    inverse = one / select(lit, total, one)
    store(numbers, ERROR_X * width, square_root(noise_x) * inverse)
    store(numbers, ERROR_Y * width, square_root(noise_y) * inverse)
