"""Per-lane rows (n_rows, W) of estimators of a spot's position; profiles and model image of the spot."""

import math
from typing import NamedTuple

import numpy as np

from faintspot.base.arrays import Array
from faintspot.slopes.kernels.compiling import compiled, inlined
from faintspot.slopes.kernels.groups import Group
from faintspot.slopes.kernels.host import aligned_zeros
from faintspot.slopes.kernels.positions.brightest import smooth_pixel, variance_of, weight_variance_of
from faintspot.slopes.kernels.simd import (
    Lanes,
    Pair,
    Vector,
    copy_transposed,
    load,
    maximum,
    minimum,
    multiply_add,
    reciprocal,
    select,
    splat,
    store,
    width_of,
)

# In: allowed positions, px.
LOW_X, HIGH_X, LOW_Y, HIGH_Y = range(4)
# State and result: position (px), flux (electrons), what of the position is not in the looked-up profiles.
X, Y, FLUX, REST_X, REST_Y = range(4, 9)
# In: variance of a pixel that collects m: VARIANCE + EXCESS * m; what is weighted with:
# WEIGHT_VARIANCE + WEIGHT_EXCESS * m + MODEL_ERROR * m^2.
VARIANCE, EXCESS, WEIGHT_VARIANCE, WEIGHT_EXCESS, MODEL_ERROR = range(9, 14)
# In: prior of the position: mean, px, and inverse variance.
PRIOR_X, PRIOR_Y, PRIOR_WEIGHT = range(14, 17)
# Sums over a lane's pixels: score, information I, and J, the covariance of the score.
SCORE_X, SCORE_Y, SCORE_F = range(17, 20)
I_XX, I_YY, I_FF, I_XY, I_XF, I_YF = range(20, 26)
J_XX, J_YY, J_FF, J_XY, J_XF, J_YF = range(26, 32)
# Out: standard errors, px, and covariance of x and y, px^2; flux that the image itself gives, whatever was
# expected, and its standard error.
ERROR_X, ERROR_Y, COVARIANCE, SEEN, SEEN_ERROR = range(32, 37)
# In: what a spot's peak, smoothed, has of its flux; factor on the steps of the weighted centre of gravity.
START_FLUX, GAIN_X, GAIN_Y = range(37, 40)
# Of the posterior on a grid of positions: mean, standard deviation, px, covariance, px^2, and the grid's
# spacing.
MEAN_X, MEAN_Y, SPREAD_X, SPREAD_Y, SPREAD_XY, SPACING = range(40, 46)
# Where the smoothed image peaks, and the flux that it shows there.
PEAK_X, PEAK_Y, PEAK_FLUX = range(46, 49)
# In: the largest move of one step, px. Out: the larger of the moves along x and y in the last two steps, px.
LARGEST_MOVE, MOVE, MOVE_BEFORE = range(49, 52)
LANE_ROWS = 52


class ModelTables(NamedTuple):
    """Tables of the kernels that use a profile: weighted and fitted estimators."""

    steps: int
    round_electrons: bool
    """Whether images are rounded to whole electrons."""
    background: bool
    """Whether a constant is fitted along with the spot."""
    taps: Array
    """(n_subapertures, 2, 1 + reach) float32: of the smoothing that finds the start."""
    model: Array
    """(n_models, 2, rank, 2, PHASES, length) float32: see `look_up`."""


class PosteriorTables(NamedTuple):
    """Tables of the kernel that starts from the mean of the posterior."""

    fit: ModelTables
    """ModelTables."""
    logarithms: Array
    """(n_tables, n_positions, ny, n_vectors * W) float32: k_p of each table and position, 0 beyond nx."""
    constants: Array
    """(n_tables, n_positions) float32: c_p."""
    grid: Array
    """(n_positions, 2) float32: x and y, px."""
    spacing: float
    """Spacing of the grid, px."""


class SpotScratch(NamedTuple):
    """Memory of one thread."""

    taps: Array
    lane_values: Array
    """(LANE_ROWS * W,)."""
    profiles: Array
    """(2, rank, 2, padded, W): of the first nx or ny of `padded` pixels."""
    rows: Array
    """(ny, n_vectors, W, W)."""
    logarithms: Array
    """(n_positions,) float64."""
    starts: Array
    """(W,) int64: free for any use."""
    models: Array
    """(W,) int64: model of each lane in `ModelTables.model`."""
    kinds: Array
    """(W,) int64: table of each lane in `PosteriorTables.logarithms`."""


def spot_scratch(
    lanes: Lanes, ny: int, nx: int, rank: int = 1, taps: int = 1, positions: int = 0
) -> SpotScratch:
    """Return the kernels' own memory, for models of a rank, a number of taps and of a grid's positions."""
    width = lanes.width
    vectors = -(-nx // width)
    padded = -(-max(ny, nx) // width) * width
    return SpotScratch(
        aligned_zeros(2 * taps * width, lanes.dtype),
        aligned_zeros(LANE_ROWS * width, lanes.dtype),
        aligned_zeros(4 * rank * padded * width, lanes.dtype).reshape(2, rank, 2, padded, width),
        aligned_zeros(ny * vectors * width * width, lanes.dtype).reshape(ny, vectors, width, width),
        np.zeros(positions),
        *(np.zeros(width, np.int64) for _ in range(3)),
    )


@inlined
def model_at(lanes: Lanes, profiles: Array, x: int, y: int) -> tuple[Vector, Vector, Vector]:
    """Return the PSF, a sum of separable terms, and its derivatives along x and y, at one pixel."""
    width, rank, padded = width_of(lanes), profiles.shape[1], profiles.shape[3]
    m = mx = my = splat(lanes, 0.0)
    for term in range(rank):
        along, across = 2 * term * padded + x, 2 * (rank + term) * padded + y
        fx, fy = load(lanes, profiles, along * width), load(lanes, profiles, across * width)
        dx = load(lanes, profiles, (along + padded) * width)
        dy = load(lanes, profiles, (across + padded) * width)
        m, mx, my = multiply_add(fx, fy, m), multiply_add(dx, fy, mx), multiply_add(fx, dy, my)
    return m, mx, my


@inlined
def noise_of(lanes: Lanes, lane_values: Array) -> tuple[Vector, Vector, Vector, Vector, Vector]:
    """Return the numbers of the lanes that `weigh` needs."""
    width = width_of(lanes)
    v, e = load(lanes, lane_values, VARIANCE * width), load(lanes, lane_values, EXCESS * width)
    wv = load(lanes, lane_values, WEIGHT_VARIANCE * width)
    we = load(lanes, lane_values, WEIGHT_EXCESS * width)
    return v, e, wv, we, load(lanes, lane_values, MODEL_ERROR * width)


@inlined
def weigh(
    lanes: Lanes,
    noise: tuple[Vector, Vector, Vector, Vector, Vector],
    variances: Array | None,
    at: int,
    m: Vector,
) -> Pair:
    """Return the weight w of the pixel at element `at`, of which the model is m, and w times its variance."""
    v, e, wv, we, model_error = noise
    expected = maximum(m, splat(lanes, 0.0))
    own = weight_variance_of(lanes, variances, at, v, wv)
    w = reciprocal(multiply_add(expected, multiply_add(expected, model_error, we), own))
    return w, w * multiply_add(expected, e, variance_of(lanes, variances, at, v))


_LEAST_LEFT = 1e-5  # of the information on the flux: below it is round-off, and the spot resembles a constant


@compiled
def subtract_background(lanes: Lanes, image: Array, pixels: int, flux: Vector) -> None:
    """Subtract from every lane's image the constant that leaves it `flux` (a vector, electrons)."""
    width = width_of(lanes)
    even, odd = splat(lanes, 0.0), splat(lanes, 0.0)  # neither addition waits for the other
    for i in range(0, pixels - 1, 2):
        even = even + load(lanes, image, i * width)
        odd = odd + load(lanes, image, (i + 1) * width)
    if pixels % 2 == 1:
        even = even + load(lanes, image, (pixels - 1) * width)
    level = (even + odd - flux) * splat(lanes, 1.0 / pixels)
    for i in range(pixels):
        store(image, i * width, load(lanes, image, i * width) - level)


@compiled
def eliminate_background(group: Group, image: Array, own: SpotScratch) -> None:
    """Turn the sums of a fit of x, y and the flux into those of a fit that has a constant as well.

    Parameters as `likelihood.fit_group`; SCORE_*, I_* and J_* are read and written.
    """
    lanes, ny, nx, profiles, lane_values = group.lanes, group.ny, group.nx, own.profiles, own.lane_values
    width, place = width_of(lanes), group.first * ny * nx
    zero = splat(lanes, 0.0)
    noise, flux = noise_of(lanes, lane_values), load(lanes, lane_values, FLUX * width)
    s, i, ix, iy, im, j, jx, jy, jm = zero, zero, zero, zero, zero, zero, zero, zero, zero
    for y in range(ny):
        for x in range(nx):
            m, mx, my = model_at(lanes, profiles, x, y)
            m = flux * m
            at = (y * nx + x) * width
            w, wt = weigh(lanes, noise, group.variances, place + at, m)
            s = multiply_add(w, load(lanes, image, at) - m, s)
            i, im = i + w, multiply_add(w, m, im)
            ix, iy = multiply_add(w, mx, ix), multiply_add(w, my, iy)
            wt = w * wt
            j, jm = j + wt, multiply_add(wt, m, jm)
            jx, jy = multiply_add(wt, mx, jx), multiply_add(wt, my, jy)
    inverse = splat(lanes, 1.0) / maximum(i, splat(lanes, 1e-30))
    cx, cy, cf = flux * ix * inverse, flux * iy * inverse, im * inverse
    _add(lanes, lane_values, SCORE_X, zero - cx * s)
    _add(lanes, lane_values, SCORE_Y, zero - cy * s)
    _add(lanes, lane_values, SCORE_F, zero - cf * s)
    whole = load(lanes, lane_values, I_FF * width)
    _add(lanes, lane_values, I_XX, zero - cx * cx * i)
    _add(lanes, lane_values, I_YY, zero - cy * cy * i)
    _add(lanes, lane_values, I_FF, zero - cf * cf * i)
    _add(lanes, lane_values, I_XY, zero - cx * cy * i)
    _add(lanes, lane_values, I_XF, zero - cx * cf * i)
    _add(lanes, lane_values, I_YF, zero - cy * cf * i)
    left = load(lanes, lane_values, I_FF * width)
    store(lane_values, I_FF * width, select(left > splat(lanes, _LEAST_LEFT) * whole, left, zero))
    jx, jy = flux * jx, flux * jy
    _add(lanes, lane_values, J_XX, cx * (cx * j - jx - jx))
    _add(lanes, lane_values, J_YY, cy * (cy * j - jy - jy))
    _add(lanes, lane_values, J_FF, cf * (cf * j - jm - jm))
    _add(lanes, lane_values, J_XY, cx * cy * j - cx * jy - cy * jx)
    _add(lanes, lane_values, J_XF, cx * cf * j - cx * jm - cf * jx)
    _add(lanes, lane_values, J_YF, cy * cf * j - cy * jm - cf * jy)


@compiled
def _add(lanes: Lanes, lane_values: Array, row: int, change: Vector) -> None:
    """Add to a row."""
    at = row * width_of(lanes)
    store(lane_values, at, load(lanes, lane_values, at) + change)


PHASES = 16
MARGIN = 2  # px that a table reaches beyond the window's side, on either end


@compiled
def look_up(group: Group, tables: Array, own: SpotScratch) -> None:
    """Write every lane's profiles, and their derivatives in the position, at its position X, Y.

    Parameters
    ----------
    group : Group
    tables : (n_models, 2, rank, 2, PHASES, length) float32
        Axis (x, y), term, value or derivative, phase, place: element i of phase p belongs to the offset
        i - MARGIN - max(ny, nx) + p / PHASES from the spot.
    own : SpotScratch
        Models and X and Y are read; REST_X, REST_Y and profiles are written.
    """
    lanes, ny, nx = group.lanes, group.ny, group.nx
    lane_values, starts, profiles = own.lane_values, own.starts, own.profiles
    width = width_of(lanes)
    rank, length, padded = tables.shape[2], tables.shape[5], profiles.shape[3]
    margin = MARGIN + max(ny, nx)
    for axis in range(2):
        n = nx if axis == 0 else ny
        first = -0.5 * (n - 1)
        # Within the window, and so within the tables; NaN becomes a bound.
        inside = maximum(load(lanes, lane_values, (X + axis) * width), splat(lanes, -0.5 * n))
        store(lane_values, (REST_X + axis) * width, minimum(inside, splat(lanes, 0.5 * n)))
        for lane in range(width):
            position = lane_values[(REST_X + axis) * width + lane]
            step = math.floor((first - position) * PHASES + 0.5)
            whole, phase = step // PHASES, step % PHASES
            starts[lane] = (
                ((own.models[lane] * 2 + axis) * rank * 2 * PHASES + phase) * length + whole + margin
            )
            lane_values[(REST_X + axis) * width + lane] = position - (first - step / PHASES)
        rest = load(lanes, lane_values, (REST_X + axis) * width)
        for term in range(rank):
            for kind in range(2):
                plane = (term * 2 + kind) * PHASES * length
                to = ((axis * rank + term) * 2 + kind) * padded
                for i in range(0, n, width):
                    copy_transposed(lanes, tables, starts, plane + i, profiles, (to + i) * width)
            value = (axis * rank + term) * 2 * padded
            for i in range(n):
                derivative = load(lanes, profiles, (value + padded + i) * width)
                here = (value + i) * width
                store(profiles, here, multiply_add(rest, derivative, load(lanes, profiles, here)))


LEAST_FLUX_E = 1.0  # an estimate of the flux below this says nothing


@compiled
def _pixel_range(lanes: Lanes, lane_values: Array, low: int, high: int, n: int) -> tuple[int, int]:
    """First and last pixel whose centre is within half a pixel of some lane's allowed positions."""
    width = width_of(lanes)
    first, last = n - 1, 0
    for lane in range(width):
        lowest, highest = lane_values[low * width + lane], lane_values[high * width + lane]
        first = min(first, math.ceil(lowest - 0.5 + 0.5 * (n - 1)))
        last = max(last, math.floor(highest + 0.5 + 0.5 * (n - 1)))
    return max(first, 0), min(last, n - 1)


@compiled
def find_start(
    lanes: Lanes, image: Array, ny: int, nx: int, reach: int, taps: Array, smoothed: Array, lane_values: Array
) -> None:
    """Write X, Y and FLUX of every lane: its largest smoothed pixel within the allowed positions.

    Of equal ones the first. FLUX follows from what such a pixel has of a spot's flux, START_FLUX.

    Parameters
    ----------
    image : (ny * nx * W,)
    reach, taps
        See `smooth_pixel`.
    smoothed : (>= ny * nx * W,), flat
        Scratch.
    """
    width = width_of(lanes)
    first_x, last_x = _pixel_range(lanes, lane_values, LOW_X, HIGH_X, nx)
    first_y, last_y = _pixel_range(lanes, lane_values, LOW_Y, HIGH_Y, ny)
    for y in range(max(first_y - reach, 0), min(last_y + reach + 1, ny)):
        for x in range(first_x, last_x + 1):
            at = (y * nx + x) * width
            store(smoothed, at, smooth_pixel(lanes, image, at, width, x, nx, taps, 0, reach))
    half, minus_half = splat(lanes, 0.5), splat(lanes, -0.5)
    low_x, high_x = load(lanes, lane_values, LOW_X * width), load(lanes, lane_values, HIGH_X * width)
    low_y, high_y = load(lanes, lane_values, LOW_Y * width), load(lanes, lane_values, HIGH_Y * width)
    best = splat(lanes, -math.inf)
    best_x, best_y = half * (low_x + high_x), half * (low_y + high_y)
    for y in range(first_y, last_y + 1):
        v = splat(lanes, y - 0.5 * (ny - 1))
        for x in range(first_x, last_x + 1):
            value = smooth_pixel(lanes, smoothed, (y * nx + x) * width, nx * width, y, ny, taps, 1, reach)
            u = splat(lanes, x - 0.5 * (nx - 1))
            inside = minimum(minimum(u - low_x, high_x - u), minimum(v - low_y, high_y - v)) >= minus_half
            value = select(inside, value, splat(lanes, -math.inf))
            larger = value > best
            best = select(larger, value, best)
            best_x, best_y = select(larger, u, best_x), select(larger, v, best_y)
    flux = best / load(lanes, lane_values, START_FLUX * width)
    store(lane_values, X * width, minimum(maximum(best_x, low_x), high_x))
    store(lane_values, Y * width, minimum(maximum(best_y, low_y), high_y))
    store(lane_values, FLUX * width, maximum(flux, splat(lanes, LEAST_FLUX_E)))
