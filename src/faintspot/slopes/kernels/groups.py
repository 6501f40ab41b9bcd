"""From frames to slopes, group by group of W sub-apertures: one driver for every estimator.

The driver gathers and calibrates a group, an estimator's own kernel locates its spots, and the driver stores
what was found. Every function here works on the groups [start, stop), so that threads can share a job;
results do not depend on how they do.
"""

import math
from functools import cache
from types import FunctionType
from typing import Any, NamedTuple

import numpy as np

from faintspot.base.arrays import Array
from faintspot.base.flags import SubapertureFlag
from faintspot.slopes.kernels.compiling import compiled, compiled_with, inlined
from faintspot.slopes.kernels.gather import Frames, calibrate, fill_bad_pixels, gather_raw, scatter_images
from faintspot.slopes.kernels.host import aligned_zeros, flush_subnormals, restore_control
from faintspot.slopes.kernels.simd import Lanes, Vector, load, maximum, select, splat, store, width_of

NO_FLUX = int(SubapertureFlag.NO_FLUX)
TOO_MANY_BAD_PIXELS = int(SubapertureFlag.TOO_MANY_BAD_PIXELS)
SATURATED = int(SubapertureFlag.SATURATED)
AT_SEARCH_LIMIT = int(SubapertureFlag.AT_SEARCH_LIMIT)

LIMIT_ROUNDING_PX = 1e-4
"""A slope so close to the search range has been limited by it; float32 positions are rounded to less."""

# Rows of the table of per-sub-aperture settings (n_rows, n_subapertures), float32, that all estimators share:
# reference position and how far from it a position may be; bad pixels; noise of a pixel that collects m
# electrons, VARIANCE + EXCESS m (negative where unknown); factor on the standard error, negative in
# sub-apertures that are known to be dark. An estimator's own rows follow.
ZERO_X, ZERO_Y, RANGE, MOST_BAD, VARIANCE, EXCESS, ERROR_SCALE = range(7)
COMMON_ROWS = 7

# Rows of a group's results (RESULT_ROWS, W): position (px from the window's middle), flux (e-), standard
# errors (px), covariance of x and y (px^2).
X, Y, FLUX, ERROR_X, ERROR_Y, COVARIANCE = range(6)
RESULT_ROWS = 6

# Rows of explain's stages (n_rows, n_frames, n_subapertures, pixels).
CALIBRATED, DENOISED, BACKGROUND = range(3)
STAGE_ROWS = 3


class Source(NamedTuple):
    """Pixels of a block of frames, and their calibration."""

    lanes: Lanes
    """Lanes: W sub-apertures at once."""
    frames: Frames
    """Frames."""
    corners: Array
    """(n_subapertures, 2) int64: row and column of every window's first pixel."""
    ny: int
    nx: int
    calibration: Array
    """(n_groups, pixels, 2, W) float32: dark in ADU, and electrons per ADU (NaN in bad pixels)."""
    saturation: float
    """In ADU."""


class Task(NamedTuple):
    """Processing of a block of frames: settings, prior and tables."""

    settings: Array
    """(n_variants, rows, n_subapertures) float32."""
    variants: Array
    """(n_frames,) int64: which of these tables a frame is measured with."""
    prior: Array
    """(1 or n_frames, 2, n_subapertures) float32: predicted x and y, px from the reference position."""
    tables: Any
    """Further tables of the estimator's kernel: a NamedTuple."""
    variances: Array | None
    """(n_groups, pixels, W) float32: variance of each dark pixel [e-^2]; None: that of the settings."""


class Group(NamedTuple):
    """One group of one frame, for an estimator's own kernel."""

    lanes: Lanes
    ny: int
    nx: int
    frame: int
    """Index of the frame in the block."""
    first: int
    """Number of the first sub-aperture; the last group of a frame repeats its last one to fill the lanes."""
    settings: Array
    """(rows, n_subapertures)."""
    predicted: Array
    """(2, n_subapertures), px from the reference position."""
    variances: Array | None
    """See `Task`; those of the group begin at element `first * pixels`."""


class Scratch(NamedTuple):
    """Memory of one thread."""

    image: Array
    """((pixels + 1) * W,): calibrated images, all lanes of a pixel side by side."""
    spare: Array
    """(pixels * W,): free for any use."""
    results: Array
    """(RESULT_ROWS * W,): written by the estimator's kernel."""
    places: Array
    """(W,) int64: free for any use."""
    flags: Array
    """(W,) int64: bits of `SubapertureFlag`; the estimator's kernel adds its own."""
    bad_counts: Array
    """(W,) int64."""
    iterations: Array
    """(W,) int64: written by the estimator's kernel."""
    own: Any
    """Scratch memory of the estimator's kernel."""


class SlopeArrays(NamedTuple):
    """Results, each (n_frames, n_subapertures); defined in `faintspot.Slopes`."""

    x: Array
    y: Array
    flux: Array
    flags: Array
    iterations: Array
    bad_pixels: Array
    standard_error_x: Array
    standard_error_y: Array
    covariance_xy: Array


def new_scratch(lanes: Lanes, ny: int, nx: int, own: tuple[Any, ...] = ()) -> Scratch:
    """Return the memory of one thread, aligned to cache lines."""
    width, pixels = lanes.width, ny * nx
    return Scratch(
        aligned_zeros((pixels + 1) * width, lanes.dtype),
        aligned_zeros(pixels * width, lanes.dtype),
        aligned_zeros(RESULT_ROWS * width, lanes.dtype),
        np.zeros(width, np.int64),
        np.zeros(width, np.int64),
        np.zeros(width, np.int64),
        np.zeros(width, np.int64),
        own,
    )


@compiled
def gather_group(source: Source, f: int, first: int, scratch: Scratch) -> None:
    """Gather and calibrate the W sub-apertures of a group; write counts of bad and saturated pixels."""
    lanes, ny, nx = source.lanes, source.ny, source.nx
    width = width_of(lanes)
    n, line = source.corners.shape[0], source.frames.counts.shape[2]
    for lane in range(width):
        s = min(first + lane, n - 1)
        scratch.places[lane] = source.corners[s, 0] * line + source.corners[s, 1]
    gather_raw(lanes, source.frames, f, scratch.places, ny, nx, scratch.spare, scratch.image)
    place = first * 2 * ny * nx
    calibrate(lanes, scratch.image, ny * nx, source.calibration, place, source.saturation, scratch.results)


@compiled
def prepare_group(source: Source, f: int, first: int, settings: Array, scratch: Scratch) -> None:
    """Gather and calibrate a group, fill bad pixels and set the flags of bad and saturated pixels."""
    width, ny, nx = width_of(source.lanes), source.ny, source.nx
    gather_group(source, f, first, scratch)
    for lane in range(width):
        s = min(first + lane, source.corners.shape[0] - 1)
        bad = int(scratch.results[lane])
        scratch.bad_counts[lane] = bad
        scratch.flags[lane] = SATURATED if scratch.results[width + lane] > 0.0 else 0
        if bad > 0:
            fill_bad_pixels(width, lane, ny, nx, scratch.image, scratch.spare)
            scratch.flags[lane] |= TOO_MANY_BAD_PIXELS if bad > settings[MOST_BAD, s] else 0


@inlined
def place_of(source: Source, item: int) -> tuple[int, int]:
    """Return the frame of a group, and its first sub-aperture."""
    width = width_of(source.lanes)
    n_groups = (source.corners.shape[0] + width - 1) // width
    return item // n_groups, item % n_groups * width


@compiled
def _within(slope: float, reach: float) -> float:
    """Clip a slope to the allowed range."""
    return min(max(slope, -reach), reach)


@compiled
def store_slope(
    f: int,
    s: int,
    settings: Array,
    x: float,
    y: float,
    flux: float,
    error_x: float,
    error_y: float,
    bits: int,
    iterations: int,
    bad_pixels: int,
    slopes: SlopeArrays,
) -> None:
    """Write all of one sub-aperture but the covariance; its position is the reference where it is invalid."""
    slopes.flux[f, s] = flux
    slopes.iterations[f, s] = iterations
    slopes.bad_pixels[f, s] = bad_pixels
    if settings[ERROR_SCALE, s] < 0.0 and bits & TOO_MANY_BAD_PIXELS == 0:
        bits |= NO_FLUX
    valid = bits & (NO_FLUX | TOO_MANY_BAD_PIXELS) == 0
    reach = settings[RANGE, s]
    away_x, away_y = x - settings[ZERO_X, s], y - settings[ZERO_Y, s]
    slopes.x[f, s] = _within(away_x, reach) if valid else 0.0
    slopes.y[f, s] = _within(away_y, reach) if valid else 0.0
    if valid and max(abs(away_x), abs(away_y)) >= reach - LIMIT_ROUNDING_PX:
        bits |= AT_SEARCH_LIMIT
    known = valid and settings[VARIANCE, s] >= 0.0
    scale = settings[ERROR_SCALE, s]
    slopes.standard_error_x[f, s] = scale * error_x if known else math.inf
    slopes.standard_error_y[f, s] = scale * error_y if known else math.inf
    slopes.flags[f, s] = bits


@compiled
def store_covariance(f: int, s: int, settings: Array, covariance: float, slopes: SlopeArrays) -> None:
    """Write the covariance of x and y, at most the product of the errors that `store_slope` wrote; or 0."""
    largest = slopes.standard_error_x[f, s] * slopes.standard_error_y[f, s]
    scale = settings[ERROR_SCALE, s]
    clipped = min(max(-largest, scale * scale * covariance), largest)
    slopes.covariance_xy[f, s] = clipped if largest < math.inf else 0.0


@compiled
def _store_group(width: int, n: int, group: Group, scratch: Scratch, slopes: SlopeArrays) -> None:
    """Write the results of a group."""
    f, found = group.frame, scratch.results
    for lane in range(min(width, n - group.first)):
        s = group.first + lane
        store_slope(
            f,
            s,
            group.settings,
            found[X * width + lane],
            found[Y * width + lane],
            found[FLUX * width + lane],
            found[ERROR_X * width + lane],
            found[ERROR_Y * width + lane],
            scratch.flags[lane],
            scratch.iterations[lane],
            scratch.bad_counts[lane],
            slopes,
        )
    # A loop of its own: together, they store too many arrays to be compiled to vectors.
    for lane in range(min(width, n - group.first)):
        store_covariance(f, group.first + lane, group.settings, found[COVARIANCE * width + lane], slopes)


def locate(group: Group, tables: Any, scratch: Scratch, stages: Array) -> None:
    """Placeholder for an estimator's own kernel, which `driver_of` inserts.

    It reads `scratch.image` and writes `scratch.results`, `scratch.iterations` and bits of `scratch.flags`;
    where `stages` has rows, it may overwrite what the images are after its steps.
    """


def measure_groups(
    source: Source, task: Task, start: int, stop: int, scratch: Scratch, slopes: SlopeArrays, stages: Array
) -> None:
    """Compute the slopes of the groups [start, stop) of a block of frames.

    Group g is group g % n_groups of frame g // n_groups.

    Parameters
    ----------
    source : Source
    task : Task
    scratch : Scratch
    slopes : SlopeArrays
        Written.
    stages : (STAGE_ROWS or 0, n_frames, n_subapertures, pixels) float32
        Written where it has rows.
    """
    lanes = source.lanes
    width, n = width_of(lanes), source.corners.shape[0]
    control = flush_subnormals()
    for item in range(start, stop):
        f, first = place_of(source, item)
        settings = task.settings[task.variants[f]]
        prepare_group(source, f, first, settings, scratch)
        for stage in range(stages.shape[0]):
            scatter_images(width, scratch.image, first, stages[stage, f])
        predicted = task.prior[min(f, task.prior.shape[0] - 1)]
        group = Group(lanes, source.ny, source.nx, f, first, settings, predicted, task.variances)
        locate(group, task.tables, scratch, stages)
        _store_group(width, n, group, scratch, slopes)
    restore_control(control)


@cache
def driver_of(kernel: Any) -> Any:
    """Return `measure_groups`, compiled with an estimator's own kernel in place of `locate`.

    A copy with globals and a name of its own: Numba's disk cache finds it again in a new process, which it
    does not for a closure or for a kernel that is passed as an argument.
    """
    own, template = kernel.py_func, measure_groups
    copy = FunctionType(template.__code__, {**template.__globals__, "locate": kernel}, template.__name__)
    copy.__qualname__ = f"{template.__name__}_{own.__module__.replace('.', '_')}_{own.__qualname__}"
    copy.__module__ = template.__module__
    return compiled_with(copy, own.__code__.co_filename)


@compiled
def flux_of_groups(source: Source, start: int, stop: int, scratch: Scratch, flux: Array) -> None:
    """Sum the pixels of every sub-aperture, electrons, bad ones as 0, into (n_frames, n_subapertures)."""
    for item in range(start, stop):
        f, first = place_of(source, item)
        gather_group(source, f, first, scratch)
        total, zero = splat(source.lanes, 0.0), splat(source.lanes, 0.0)
        for i in range(source.ny * source.nx):
            g = load(source.lanes, scratch.image, i * width_of(source.lanes))
            total = total + select(g >= g, g, zero)
        _store_flux(source.lanes, total, f, first, scratch, flux)


@compiled
def flux_above_edges(source: Source, start: int, stop: int, scratch: Scratch, flux: Array) -> None:
    """Sum the pixels of each sub-aperture like `flux_of_groups`, above the mean of its outermost pixels."""
    lanes, ny, nx = source.lanes, source.ny, source.nx
    zero, one = splat(lanes, 0.0), splat(lanes, 1.0)
    for item in range(start, stop):
        f, first = place_of(source, item)
        gather_group(source, f, first, scratch)
        inner, inner_count, edge, edge_count = zero, zero, zero, zero
        for y in range(ny):
            for x in range(nx):
                g = load(lanes, scratch.image, (y * nx + x) * width_of(lanes))
                good = g >= g
                value, count = select(good, g, zero), select(good, one, zero)
                if y == 0 or y == ny - 1 or x == 0 or x == nx - 1:
                    edge, edge_count = edge + value, edge_count + count
                else:
                    inner, inner_count = inner + value, inner_count + count
        above = inner - inner_count * (edge / maximum(edge_count, one))
        _store_flux(lanes, above, f, first, scratch, flux)


@inlined
def _store_flux(lanes: Lanes, total: Vector, f: int, first: int, scratch: Scratch, flux: Array) -> None:
    """Write the flux of a group."""
    store(scratch.results, 0, total)
    for lane in range(min(width_of(lanes), flux.shape[1] - first)):
        flux[f, first + lane] = scratch.results[lane]
