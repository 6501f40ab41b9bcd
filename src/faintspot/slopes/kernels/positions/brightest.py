"""Brightest-pixel background subtraction, centre of gravity and smoothing of W images, one in each lane."""

import math
from typing import Any

from faintspot.base.arrays import Array
from faintspot.slopes.kernels.compiling import compiled, inlined
from faintspot.slopes.kernels.simd import (
    Lanes,
    Pair,
    Vector,
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

SMALLEST_VARIANCE = 1e-4
"""Electrons squared: keeps the weights finite where there is no noise."""

# Rows of the table of per-lane numbers (n_rows, W).
RANK = 0  # in: the threshold is the RANK-th largest pixel
SUBTRACT = 1  # in: 1 to take the threshold off the pixels that stay, 0 to keep them as they are
THRESHOLD = 2  # out
LARGEST = 3  # out: largest magnitude of the image
# Out, in the order of a group's results: centre of gravity of what stays, px from the centre, and its flux;
# standard errors, px, and covariance, px^2.
X, Y, SUM, ERROR_X, ERROR_Y, COVARIANCE = range(4, 10)
VARIANCE, EXCESS = 10, 11  # in: variance of a pixel that collects m electrons, VARIANCE + EXCESS m
SPREAD = 12  # in: pixels over which denoising correlates the noise
LANE_ROWS = 13
# Least squared ratio of the flux that stays to its noise; below it, errors are not proportional to the noise.
_SIGNIFICANT = 6.25
_CORRELATED = 3.0  # noise that remains after smoothing and a threshold, over that of as many pixels

_COUNTING_PASSES = 24  # usually 5 to 8 are enough; outliers go on to the exact passes


@compiled
def gather_taps(width: int, first: int, taps: Array, lane_taps: Array) -> None:
    """Put the taps (n_subapertures, 2, 1 + reach) of a group side by side: (2, 1 + reach, W)."""
    n, _, count = taps.shape
    for lane in range(width):
        s = min(first + lane, n - 1)
        for axis in range(2):
            for k in range(count):
                lane_taps[(axis * count + k) * width + lane] = taps[s, axis, k]


@compiled
def smooth_pixel(
    lanes: Lanes, image: Array, at: int, step: int, place: int, n: int, taps: Array, axis: int, reach: int
) -> Vector:
    """One pixel smoothed along one axis; `place` of n counts along it, `step` elements lie between two.

    `taps` is (2, 1 + reach, W), flat: along x and y, the central one first.
    """
    width = width_of(lanes)
    value = load(lanes, image, at) * load(lanes, taps, axis * (reach + 1) * width)
    for k in range(1, reach + 1):
        both = splat(lanes, 0.0)
        if place >= k:
            both = both + load(lanes, image, at - k * step)
        if place + k < n:
            both = both + load(lanes, image, at + k * step)
        value = multiply_add(both, load(lanes, taps, (axis * (reach + 1) + k) * width), value)
    return value


@compiled
def smooth_group(
    lanes: Lanes, image: Array, ny: int, nx: int, reach: int, taps: Array, half_done: Array, output: Array
) -> None:
    """Smooth whole images along x, into `half_done`, then along y."""
    width = width_of(lanes)
    for y in range(ny):
        for x in range(nx):
            at = (y * nx + x) * width
            store(half_done, at, smooth_pixel(lanes, image, at, width, x, nx, taps, 0, reach))
    for y in range(ny):
        for x in range(nx):
            at = (y * nx + x) * width
            store(output, at, smooth_pixel(lanes, half_done, at, nx * width, y, ny, taps, 1, reach))


@compiled
def variance_of(lanes: Lanes, variances: Array | None, at: int, mean: Vector) -> Vector:
    """Return the variance of the pixel at element `at`; `mean` where it is the same in all."""
    if variances is None:
        return mean
    return load(lanes, variances, at)


@compiled
def weight_variance_of(
    lanes: Lanes, variances: Array | None, at: int, mean: Vector, weight: Vector
) -> Vector:
    """Return the variance that weighs the pixel at `at`; `weight` weighs a pixel of variance `mean`."""
    if variances is None:
        return weight
    own = load(lanes, variances, at)
    return maximum(own + (weight - mean), splat(lanes, SMALLEST_VARIANCE))


@compiled
def relative_variance(lanes: Lanes, variances: Array | None, at: int, mean: Vector) -> Vector:
    """Return the variance of the pixel at `at` in units of `mean`, neither below the smallest."""
    if variances is None:
        return splat(lanes, 1.0)
    least = splat(lanes, SMALLEST_VARIANCE)
    return maximum(load(lanes, variances, at), least) / maximum(mean, least)


@compiled
def without_noisy_pixels(
    lanes: Lanes, variances: Array | None, place: int, pixels: int, mean: Vector, image: Array, damped: Array
) -> Array:
    """Return an image in which pixels noisier than the mean variance count less, by the ratio of variances.

    It is written to `damped`; without variances the image itself is returned.
    """
    if variances is None:
        return image
    width = width_of(lanes)
    for i in range(pixels):
        relative = relative_variance(lanes, variances, place + i * width, mean)
        store(damped, i * width, load(lanes, image, i * width) / maximum(relative, splat(lanes, 1.0)))
    return damped


@inlined
def _tally(lanes: Lanes, image: Array, at: int, pivot: Vector, count: Vector, total: Vector) -> Pair:
    """Add one pixel to number and sum of those above the pivot."""
    g = load(lanes, image, at)
    above = g > pivot
    return select(above, count + splat(lanes, 1.0), count), select(above, total + g, total)


@compiled
def _sum_above(lanes: Lanes, image: Array, pixels: int, pivot: Vector) -> Pair:
    """Return number and sum of the pixels above the pivot, in four independent sums."""
    width = width_of(lanes)
    zero = splat(lanes, 0.0)
    n0 = n1 = n2 = n3 = s0 = s1 = s2 = s3 = zero
    whole = pixels - pixels % 4
    for i in range(0, whole, 4):
        n0, s0 = _tally(lanes, image, i * width, pivot, n0, s0)
        n1, s1 = _tally(lanes, image, (i + 1) * width, pivot, n1, s1)
        n2, s2 = _tally(lanes, image, (i + 2) * width, pivot, n2, s2)
        n3, s3 = _tally(lanes, image, (i + 3) * width, pivot, n3, s3)
    for i in range(whole, pixels):
        n0, s0 = _tally(lanes, image, i * width, pivot, n0, s0)
    return (n0 + n1) + (n2 + n3), (s0 + s1) + (s2 + s3)


@compiled
def _range_and_sum(lanes: Lanes, image: Array, pixels: int) -> tuple[Vector, Vector, Vector]:
    """Return the smallest and the largest pixel, and the sum of all."""
    width = width_of(lanes)
    low = high = other_low = other_high = load(lanes, image, 0)
    total = other_total = splat(lanes, 0.0)
    for i in range(0, pixels - 1, 2):
        g = load(lanes, image, i * width)
        low, high, total = minimum(g, low), maximum(g, high), total + g
        g = load(lanes, image, (i + 1) * width)
        other_low, other_high, other_total = minimum(g, other_low), maximum(g, other_high), other_total + g
    if pixels % 2 == 1:
        g = load(lanes, image, (pixels - 1) * width)
        low, high, total = minimum(g, low), maximum(g, high), total + g
    return minimum(low, other_low), maximum(high, other_high), total + other_total


@compiled
def _middle(lanes: Lanes, low: Vector, high: Vector) -> Vector:
    """Return a number in [low, high), for low < high, near the middle."""
    half = splat(lanes, 0.5)
    middle = maximum(half * low + half * high, low)
    return select(middle < high, middle, low)


@inlined
def _pivot(lanes: Lanes, mean: Vector, low: Vector, high: Vector, wanted: Vector) -> Vector:
    """Return a pivot in a bracket, with about the wanted fraction of the bracket's pixels above it.

    The mean parts them in halves. How far to go from it follows from the most variance that a distribution of
    this range and mean can have: saves a quarter of the passes.
    """
    away = splat(lanes, 1.0) - (wanted + wanted)
    return multiply_add(away * (mean - low), (high - mean) / (high - low), mean)


@compiled
def _bracket(
    lanes: Lanes, image: Array, pixels: int, rank: Vector, low: Vector, high: Vector, total: Vector
) -> tuple[Vector, Vector, Vector, Vector]:
    """Part the RANK-th largest pixel from its neighbours in rank, or from all that differ from it.

    As quickselect does, but without moving pixels: count those above a pivot. Returns low and high, and how
    many pixels are above each: rank is that above low, or one more than that above high, or all between are
    likely to be equal. Low is -inf where nothing was found below.
    """
    one, zero, half = splat(lanes, 1.0), splat(lanes, 0.0), splat(lanes, 0.5)
    low_count, high_count, low_sum, high_sum = splat(lanes, pixels), zero, total, zero
    bottom, stalled = splat(lanes, -math.inf), zero
    for _ in range(_COUNTING_PASSES):
        between = maximum(low_count - high_count, one)
        mean = (low_sum - high_sum) / between
        pivot = _pivot(lanes, mean, low, high, (rank - half - high_count) / between)
        pivot = select(stalled > zero, mean, pivot)
        middle = _middle(lanes, low, high)
        pivot = select(pivot >= low, select(pivot < high, pivot, middle), middle)
        count, above = _sum_above(lanes, image, pixels, pivot)
        up = count >= rank
        low, bottom, low_sum = select(up, pivot, low), select(up, pivot, bottom), select(up, above, low_sum)
        high, high_sum = select(up, high, pivot), select(up, high_sum, above)
        low_count, high_count = select(up, count, low_count), select(up, high_count, count)
        left = low_count - high_count
        # Nothing parted from the rest: once is bad luck; at the mean, it means that they are equal.
        stalled = select(left < between, zero, stalled + one)
        open_lane = minimum(low_count - rank, rank - one - high_count) > zero
        if not any_lane(select(open_lane, stalled, one + one) < one + one):
            break
    return bottom, high, low_count, high_count


@compiled
def _ends(lanes: Lanes, image: Array, pixels: int, low: Vector, high: Vector) -> Pair:
    """Return the smallest pixel above low, and the largest one not above high."""
    width = width_of(lanes)
    most, least = splat(lanes, math.inf), splat(lanes, -math.inf)
    first, last = most, least
    for i in range(pixels):
        g = load(lanes, image, i * width)
        first = minimum(select(g > low, g, most), first)
        last = maximum(select(g > high, least, g), last)
    return first, last


@compiled
def _step_exactly(lanes: Lanes, image: Array, pixels: int, rank: Vector, low: Vector, high: Vector) -> Pair:
    """Halve the bracket [low, high] of the RANK-th largest pixel; its new ends are pixel values."""
    width = width_of(lanes)
    zero, one = splat(lanes, 0.0), splat(lanes, 1.0)
    pivot = _middle(lanes, low, high)
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
def find_threshold(lanes: Lanes, image: Array, pixels: int, lane_values: Array) -> None:
    """Find the RANK-th largest pixel of every lane, exactly, and the largest magnitude."""
    width = width_of(lanes)
    one = splat(lanes, 1.0)
    rank = load(lanes, lane_values, RANK * width)
    low, high, total = _range_and_sum(lanes, image, pixels)
    store(lane_values, LARGEST * width, maximum(absolute(low), absolute(high)))
    low, high, low_count, high_count = _bracket(lanes, image, pixels, rank, low, high, total)
    first, last = _ends(lanes, image, pixels, low, high)
    low = select(rank >= low_count, first, select(rank <= high_count + one, last, first))
    high = select(rank >= low_count, first, last)
    while any_lane(low < high):  # ties among others, or outliers that spoil the means
        low, high = _step_exactly(lanes, image, pixels, rank, low, high)
    store(lane_values, THRESHOLD * width, low)


@compiled
def find_largest(lanes: Lanes, image: Array, pixels: int, lane_values: Array) -> None:
    """Find the largest magnitude of every lane."""
    width = width_of(lanes)
    largest = splat(lanes, 0.0)
    for i in range(pixels):
        largest = maximum(absolute(load(lanes, image, i * width)), largest)
    store(lane_values, LARGEST * width, largest)


@compiled
def subtract_background(lanes: Lanes, image: Array, pixels: int, lane_values: Array, left: Array) -> None:
    """Zero the pixels below THRESHOLD, and take it off the others where SUBTRACT is 1; `left` is written."""
    width = width_of(lanes)
    zero = splat(lanes, 0.0)
    threshold = load(lanes, lane_values, THRESHOLD * width)
    offset = select(load(lanes, lane_values, SUBTRACT * width) > zero, threshold, zero)
    for i in range(pixels):
        g = load(lanes, image, i * width)
        store(left, i * width, select(g >= threshold, g - offset, zero))


@inlined
def _from_middle(lanes: Lanes, i: int, n: int) -> Vector:
    """Return the position of pixel i of n [px]."""
    return splat(lanes, i - 0.5 * (n - 1))


@compiled
def _store_centre(
    lanes: Lanes, total: Vector, moment_x: Vector, moment_y: Vector, lane_values: Array
) -> Vector:
    """Write SUM, X and Y, (0, 0) where the sum is not positive; return 1 / SUM, or 1."""
    width = width_of(lanes)
    zero, one = splat(lanes, 0.0), splat(lanes, 1.0)
    illuminated = total > zero
    inverse = one / select(illuminated, total, one)
    store(lane_values, SUM * width, total)
    store(lane_values, X * width, select(illuminated, moment_x * inverse, zero))
    store(lane_values, Y * width, select(illuminated, moment_y * inverse, zero))
    return inverse


@compiled
def centre_of_gravity(lanes: Lanes, image: Array, ny: int, nx: int, lane_values: Array) -> None:
    """Write the flux after THRESHOLD and SUBTRACT in each lane, and its centre of gravity.

    (0, 0) where the sum is not positive.
    """
    width = width_of(lanes)
    zero = splat(lanes, 0.0)
    threshold = load(lanes, lane_values, THRESHOLD * width)
    offset = select(load(lanes, lane_values, SUBTRACT * width) > zero, threshold, zero)
    total, moment_x, moment_y = zero, zero, zero
    for y in range(ny):
        row, row_x = zero, zero  # sums by row: rows do not wait for each other
        for x in range(nx):
            g = load(lanes, image, (y * nx + x) * width)
            left = select(g >= threshold, g - offset, zero)
            row, row_x = row + left, multiply_add(left, _from_middle(lanes, x, nx), row_x)
        total, moment_x = total + row, moment_x + row_x
        moment_y = multiply_add(row, _from_middle(lanes, y, ny), moment_y)
    _store_centre(lanes, total, moment_x, moment_y, lane_values)


@compiled
def centre_and_error(
    lanes: Lanes,
    measured: Array,
    variances: Array | None,
    place: int,
    image: Array,
    ny: int,
    nx: int,
    lane_values: Array,
) -> None:
    """Write the centre of gravity and its errors: the propagated noise of the remaining pixels.

    That of a pixel is VARIANCE + EXCESS m, with m as measured and, if given, `variances` in place of
    VARIANCE; `image` may be denoised. Pixels that noise alone raises above the threshold vary less, as most
    of them would be zero in another frame: on average by the square of what remains. Errors of a flux that
    is not significant are infinite.
    """
    width = width_of(lanes)
    zero = splat(lanes, 0.0)
    threshold = load(lanes, lane_values, THRESHOLD * width)
    offset = select(load(lanes, lane_values, SUBTRACT * width) > zero, threshold, zero)
    v, e = load(lanes, lane_values, VARIANCE * width), load(lanes, lane_values, EXCESS * width)
    spread = load(lanes, lane_values, SPREAD * width)
    total, moment_x, moment_y = zero, zero, zero
    noise, noise_x, noise_xx, noise_y, noise_yy, noise_xy = zero, zero, zero, zero, zero, zero
    for y in range(ny):
        row, row_x, part, part_x, part_xx = zero, zero, zero, zero, zero
        for x in range(nx):
            here, column = (y * nx + x) * width, _from_middle(lanes, x, nx)
            g = load(lanes, image, here)
            left = select(g >= threshold, g - offset, zero)
            row, row_x = row + left, multiply_add(left, column, row_x)
            own = variance_of(lanes, variances, place + here, v)
            variance = multiply_add(load(lanes, measured, here), e, own)
            above = g - threshold
            by_noise = above * above * spread < maximum(variance, zero)
            variance = select(by_noise, left * left * spread, variance)
            variance = select(absolute(left) > zero, variance, zero)
            away = variance * column
            part, part_x, part_xx = part + variance, part_x + away, multiply_add(away, column, part_xx)
        line = _from_middle(lanes, y, ny)
        total, moment_x, moment_y = total + row, moment_x + row_x, multiply_add(row, line, moment_y)
        noise, noise_x, noise_xx = noise + part, noise_x + part_x, noise_xx + part_xx
        noise_xy = multiply_add(part_x, line, noise_xy)
        away = part * line
        noise_y, noise_yy = noise_y + away, multiply_add(away, line, noise_yy)
    inverse = _store_centre(lanes, total, moment_x, moment_y, lane_values)
    significant = total * total > splat(lanes, _SIGNIFICANT) * noise
    relative = select(significant, inverse, splat(lanes, math.inf))
    _store_error(lanes, noise, noise_x, noise_xx, relative, X, ERROR_X, lane_values)
    _store_error(lanes, noise, noise_y, noise_yy, relative, Y, ERROR_Y, lane_values)
    at_x, at_y = load(lanes, lane_values, X * width), load(lanes, lane_values, Y * width)
    around = noise_xy - at_x * noise_y - at_y * (noise_x - at_x * noise)
    store(lane_values, COVARIANCE * width, around * inverse * inverse)


@compiled
def _store_error(
    lanes: Lanes,
    noise: Any,
    first: Any,
    second: Any,
    inverse: Vector,
    position: Any,
    error: Any,
    lane_values: Array,
) -> None:
    """Write a standard error, from the noise's moments about the window's middle."""
    width = width_of(lanes)
    at = load(lanes, lane_values, position * width)
    # The position of the flux within a pixel is unknown: px^2 / 12.
    around = multiply_add(noise, multiply_add(at, at, splat(lanes, 1.0 / 12.0)), second)
    around = multiply_add(first, splat(lanes, -2.0) * at, around)
    value = square_root(maximum(around, splat(lanes, 0.0))) * inverse
    store(lane_values, error * width, select(inverse < splat(lanes, math.inf), value, inverse))


@compiled
def errors_of_smoothed(
    lanes: Lanes,
    measured: Array,
    variances: Array | None,
    place: int,
    image: Array,
    ny: int,
    nx: int,
    smoothing: Any,
    lane_values: Array,
) -> None:
    """Replace finite errors of `centre_and_error` by those of a smoothed image.

    The smoothing is its own adjoint: a pixel as measured moves the centre by the smoothed weights of the
    pixels that remain. `smoothing` is reach, taps, and memory of three images.
    """
    reach, taps, weights = smoothing
    width = width_of(lanes)
    size = ny * nx * width
    half, of_x, of_y = weights[:size], weights[size : 2 * size], weights[2 * size : 3 * size]
    zero, tiny = splat(lanes, 0.0), splat(lanes, 1e-30)
    threshold = load(lanes, lane_values, THRESHOLD * width)
    at_x, at_y = load(lanes, lane_values, X * width), load(lanes, lane_values, Y * width)
    v, e = load(lanes, lane_values, VARIANCE * width), load(lanes, lane_values, EXCESS * width)
    spread = load(lanes, lane_values, SPREAD * width) * splat(lanes, _CORRELATED)
    for y in range(ny):
        for x in range(nx):
            here = (y * nx + x) * width
            g = load(lanes, image, here)
            own = maximum(multiply_add(g, e, variance_of(lanes, variances, place + here, v)), tiny)
            above = maximum(g - threshold, zero)
            weight = square_root(minimum(above * above * spread, own) / own)
            store(of_x, here, weight * (_from_middle(lanes, x, nx) - at_x))
            store(of_y, here, weight * (_from_middle(lanes, y, ny) - at_y))
    smooth_group(lanes, of_x, ny, nx, reach, taps, half, of_x)
    smooth_group(lanes, of_y, ny, nx, reach, taps, half, of_y)
    noise_xx, noise_yy, noise_xy = zero, zero, zero
    for i in range(0, size, width):
        own = variance_of(lanes, variances, place + i, v)
        variance = multiply_add(load(lanes, measured, i), e, own)
        x, y = load(lanes, of_x, i), load(lanes, of_y, i)
        noise_xx, noise_yy = multiply_add(variance * x, x, noise_xx), multiply_add(variance * y, y, noise_yy)
        noise_xy = multiply_add(variance * x, y, noise_xy)
    inverse = splat(lanes, 1.0) / maximum(load(lanes, lane_values, SUM * width), tiny)
    for row, noise in ((ERROR_X, noise_xx), (ERROR_Y, noise_yy)):
        before = load(lanes, lane_values, row * width)
        error = square_root(maximum(noise, zero)) * inverse
        store(lane_values, row * width, select(before < splat(lanes, math.inf), error, before))
    store(lane_values, COVARIANCE * width, noise_xy * inverse * inverse)
