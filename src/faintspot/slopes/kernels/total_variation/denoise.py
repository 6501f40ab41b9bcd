"""Constrained total-variation denoising of a group of W sub-apertures, one in each SIMD lane.

The multiplier follows from the constraint, lambda = sqrt(N) noise_std / ||div q||, renewed in every
iteration from the norm that the preceding sweep has summed up; the accelerated iteration tolerates that it
is one iteration old, so that one sweep is enough.

References: Chambolle 2004 (J. Math. Imaging Vis. 20, 89), Beck & Teboulle 2009 (IEEE Trans. Image Process.
18, 2419).
"""

import math
from typing import Any

from faintspot.base.arrays import Array
from faintspot.slopes.kernels.compiling import compiled
from faintspot.slopes.kernels.simd import (
    Lanes,
    Vector,
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
from faintspot.slopes.kernels.total_variation.flat_start import MOMENTUM_AGE, start_flat
from faintspot.slopes.kernels.total_variation.sweeps import (
    IMAGE,
    STATE_VECTORS,
    sweep_chambolle,
    sweep_fgp,
    twice_divergence,
)

# Iterations between two convergence tests, which compare the images of both. Where a wide, shallow residue is
# left, a single iteration changes little. A group goes on until its slowest lane has finished.
CHECK_INTERVAL = 24
# In units of the image's own rms: a strength above the first is too strong for the image, and is lowered to
# the second where that is asked for. Chosen by the slope error of simulated spots, docs/automatic.md.
HIGHEST_STRENGTH, LOWERED_STRENGTH = 0.9, 0.6

# Of two types, so that "chambolle" is compiled only where it is used.
FGP, CHAMBOLLE = None, True

# Rows of the table of per-lane numbers (n_rows, W), in the precision of the lanes.
STRENGTH, TOLERANCE = 0, 1  # in: noise_std in image units, relative change at which to stop
MEAN, SCALE = 2, 3  # of the image: what normalisation takes off
RADIUS = 4  # sqrt(N) * strength / scale: the norm that lambda * div p must have
CHANGE, SIZE = 5, 6  # squared norms that the convergence test compares
FINISHING = 7  # 1 in lanes whose result is written next
MULTIPLIER = 8  # out: lambda in image units
LANE_ROWS = 9

# Rows of the table of per-lane whole numbers (n_rows, W).
LIMIT, ITERATIONS, CONVERGED, INFEASIBLE, ACTIVE = 0, 1, 2, 3, 4
COUNT_ROWS = 5


def row_vectors(ny: int, nx: int) -> int:
    """Return the size of `rows` of `denoise_group`, in vectors."""
    return 2 * ny * nx + 2 * nx + 3


@compiled
def _measure_change(
    lanes: Lanes,
    state: Array,
    rows: Array,
    ny: int,
    nx: int,
    current: int,
    inverse: Vector,
    lane_values: Array,
) -> None:
    """Sum ||div p - div p_then||^2 and ||div p - g / lambda||^2 per lane, both times 4, since the last test.

    div p is kept in `rows`, behind what the sweeps use, for the next test.
    """
    width = width_of(lanes)
    kept = (ny * nx + 2 * nx + 3) * width
    zero = splat(lanes, 0.0)
    minus_inverse = splat(lanes, -2.0) * inverse
    pixel, line = STATE_VECTORS * width, nx * STATE_VECTORS * width
    change, size = zero, zero
    for y in range(ny):
        for x in range(nx):
            place = y * line + x * pixel
            d = twice_divergence(lanes, state, place, current * width, y, x, line, pixel)
            then = kept + (y * nx + x) * width
            move = d - load(lanes, rows, then)
            store(rows, then, d)
            v = multiply_add(load(lanes, state, place + IMAGE * width), minus_inverse, d)
            change = multiply_add(move, move, change)
            size = multiply_add(v, v, size)
    store(lane_values, CHANGE * width, change)
    store(lane_values, SIZE * width, size)


@compiled
def _write_finished(
    lanes: Lanes, state: Array, rows: Array, output: Array, ny: int, nx: int, current: int, lane_values: Array
) -> None:
    """Write u = g - lambda div p of the lanes that finish now, with lambda such that the constraint holds."""
    width = width_of(lanes)
    zero = splat(lanes, 0.0)
    pixel, line = STATE_VECTORS * width, nx * STATE_VECTORS * width
    norm = zero
    for y in range(ny):
        for x in range(nx):
            d = twice_divergence(lanes, state, y * line + x * pixel, current * width, y, x, line, pixel)
            norm = multiply_add(d, d, norm)
            store(rows, (y * nx + x) * width, d)
    finishing = load(lanes, lane_values, FINISHING * width) > zero
    mean, scale = load(lanes, lane_values, MEAN * width), load(lanes, lane_values, SCALE * width)
    half_multiplier = load(lanes, lane_values, RADIUS * width) / square_root(norm)
    half_multiplier = select(norm > zero, half_multiplier, zero)
    old = load(lanes, lane_values, MULTIPLIER * width)
    store(
        lane_values, MULTIPLIER * width, select(finishing, (half_multiplier + half_multiplier) * scale, old)
    )
    for here in range(0, ny * nx * width, width):
        g = load(lanes, state, here * STATE_VECTORS + IMAGE * width)
        u = multiply_add(g - half_multiplier * load(lanes, rows, here), scale, mean)
        store(output, here, select(finishing, u, load(lanes, output, here)))


@compiled
def _prepare(
    lanes: Lanes, image: Array, state: Array, ny: int, nx: int, smallest_range: float, lane_values: Array
) -> None:
    """Normalise the images into the state.

    Normalisation (mean to zero, largest deviation to one) keeps every intermediate of order one, whatever
    the unit of the images; a range below `smallest_range` counts as constant. Leaves the sum of squared
    normalised deviations in SIZE.
    """
    width = width_of(lanes)
    zero, one = splat(lanes, 0.0), splat(lanes, 1.0)
    pixels = splat(lanes, ny * nx)
    total = zero
    low = high = load(lanes, image, 0)
    for y in range(ny):
        row = zero  # sums by row: smaller rounding error than one long sum
        for x in range(nx):
            g = load(lanes, image, (y * nx + x) * width)
            row = row + g
            low, high = minimum(g, low), maximum(g, high)
        total = total + row
    mean = total / pixels
    scale = maximum(high - mean, mean - low)
    scale = select((high - low) > splat(lanes, smallest_range), scale, zero)
    inverse = select(scale > zero, one / select(scale > zero, scale, one), zero)
    squares = zero
    for here in range(0, ny * nx * width, width):
        g = (load(lanes, image, here) - mean) * inverse
        squares = multiply_add(g, g, squares)
        store(state, here * STATE_VECTORS + IMAGE * width, g)
    store(lane_values, MEAN * width, mean)
    store(lane_values, SCALE * width, scale)
    store(lane_values, SIZE * width, squares)


@compiled
def _copy_lane(width: int, lane: int, pixels: int, image: Array, output: Array) -> None:
    for i in range(lane, pixels * width, width):
        output[i] = image[i]


@compiled
def _decide_beforehand(
    width: int,
    pixels: int,
    smallest: float,
    lowers: bool,
    image: Array,
    output: Array,
    lane_values: Array,
    counts: Array,
) -> int:
    """Settle the lanes that need no iteration; return how many remain active.

    Constant images and strength zero (or below the rounding error of the image) return the image itself;
    a strength at or above the image's own rms returns its mean, unless it is lowered.
    """
    active = 0
    for lane in range(width):
        strength, scale = lane_values[STRENGTH * width + lane], lane_values[SCALE * width + lane]
        counts[ITERATIONS * width + lane] = 0
        counts[CONVERGED * width + lane] = 1
        counts[INFEASIBLE * width + lane] = 0
        counts[ACTIVE * width + lane] = 0
        lane_values[MULTIPLIER * width + lane] = 0.0
        lane_values[RADIUS * width + lane] = 1.0
        if scale <= 0.0 or strength <= smallest * scale:
            _copy_lane(width, lane, pixels, image, output)
            if scale <= 0.0 and strength > 0.0:
                counts[INFEASIBLE * width + lane] = 1
                lane_values[MULTIPLIER * width + lane] = math.inf
            continue
        radius = math.sqrt(pixels) * (strength / scale)
        norm = math.sqrt(lane_values[SIZE * width + lane])
        if lowers and radius > HIGHEST_STRENGTH * norm:
            counts[INFEASIBLE * width + lane] = 1
            radius = LOWERED_STRENGTH * norm
        elif radius >= norm:
            counts[INFEASIBLE * width + lane] = 1
            lane_values[MULTIPLIER * width + lane] = math.inf
            for i in range(pixels):
                output[i * width + lane] = lane_values[MEAN * width + lane]
            continue
        lane_values[RADIUS * width + lane] = radius
        if counts[LIMIT * width + lane] <= 0:
            _copy_lane(width, lane, pixels, image, output)
            counts[CONVERGED * width + lane] = 0
            continue
        counts[ACTIVE * width + lane] = 1
        active += 1
    return active


@compiled
def _next_limit(width: int, counts: Array) -> int:
    """The smallest iteration limit among the active lanes."""
    limit = 1 << 62
    for lane in range(width):
        if counts[ACTIVE * width + lane]:
            limit = min(limit, counts[LIMIT * width + lane])
    return limit


@compiled
def _mark_finished(width: int, iteration: int, tested: int, lane_values: Array, counts: Array) -> int:
    """Mark the active lanes that have converged or reached their limit; return how many."""
    finished = 0
    for lane in range(width):
        lane_values[FINISHING * width + lane] = 0.0
        if not counts[ACTIVE * width + lane]:
            continue
        tolerance = lane_values[TOLERANCE * width + lane]
        bound = tolerance * tolerance * lane_values[SIZE * width + lane]
        ends = iteration >= counts[LIMIT * width + lane]
        converged = tested and tolerance > 0.0 and lane_values[CHANGE * width + lane] <= bound
        if converged or ends:
            counts[CONVERGED * width + lane] = 1 if converged else 0
            counts[ITERATIONS * width + lane] = iteration
            counts[ACTIVE * width + lane] = 0
            lane_values[FINISHING * width + lane] = 1.0
            finished += 1
    return finished


@compiled
def denoise_group(
    lanes: Lanes,
    algorithm: bool | None,
    lowers: bool,
    table: Array,
    window: tuple[int, int],
    image: Array,
    output: Array,
    own: Any,
) -> None:
    """Denoise the W images of a group.

    Parameters
    ----------
    lanes : Lanes
    algorithm : None or bool
        FGP or CHAMBOLLE.
    lowers : bool
        Whether a strength above HIGHEST_STRENGTH is lowered, as indicated by INFEASIBLE.
    table : array
        From `flat_start_table`.
    window : (ny, nx)
    image, output : (ny * nx * W,) arrays
        Input, which is not modified, and result: all lanes of a pixel side by side.
    own : GravityScratch
        STRENGTH, TOLERANCE and LIMIT are read; MULTIPLIER, ITERATIONS, CONVERGED and INFEASIBLE are written.
    """
    ny, nx = window
    state, rows, lane_values, counts = own.state, own.rows, own.denoiser, own.counts
    width = width_of(lanes)
    # Strengths below the images' rounding error count as zero; ranges whose inverse overflows, as constant.
    smallest, smallest_range = (1e-8, 1e-30) if image.itemsize == 4 else (1e-17, 1e-290)
    _prepare(lanes, image, state, ny, nx, smallest_range, lane_values)
    active = _decide_beforehand(width, ny * nx, smallest, lowers, image, output, lane_values, counts)
    if active == 0:
        return
    test_change = False
    for lane in range(width):
        test_change |= lane_values[TOLERANCE * width + lane] > 0.0
    zero = splat(lanes, 0.0)
    inverse_radius = splat(lanes, 1.0) / load(lanes, lane_values, RADIUS * width)
    inverse = start_flat(lanes, state, rows, ny, nx, table, inverse_radius)
    limit = _next_limit(width, counts)
    momentum, momentum_age, current, iteration = 0.0, MOMENTUM_AGE, 0, 0
    if test_change:
        _measure_change(lanes, state, rows, ny, nx, current, inverse, lane_values)
    while active > 0:
        iteration += 1
        if algorithm is FGP:
            norm = sweep_fgp(lanes, state, rows, ny, nx, current, splat(lanes, momentum), inverse)
        else:
            norm = sweep_chambolle(lanes, state, rows, ny, nx, current, inverse)
        current = 2 - current
        inverse = select(norm > zero, square_root(norm) * inverse_radius, inverse)
        next_age = 0.5 * (1.0 + math.sqrt(1.0 + 4.0 * momentum_age * momentum_age))
        momentum, momentum_age = (momentum_age - 1.0) / next_age, next_age
        tested = test_change and iteration % CHECK_INTERVAL == 0
        if tested:
            _measure_change(lanes, state, rows, ny, nx, current, inverse, lane_values)
        if tested or iteration >= limit:
            finished = _mark_finished(width, iteration, tested, lane_values, counts)
            if finished > 0:
                _write_finished(lanes, state, rows, output, ny, nx, current, lane_values)
                active -= finished
                limit = _next_limit(width, counts)
