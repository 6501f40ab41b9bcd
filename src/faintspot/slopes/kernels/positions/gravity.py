"""Centres of gravity of the brightest pixels, after denoising or smoothing; their steps on stacks."""

import math
from typing import Any, NamedTuple

import numpy as np

from faintspot.base.arrays import Array
from faintspot.base.flags import SubapertureFlag
from faintspot.slopes.kernels.compiling import compiled
from faintspot.slopes.kernels.gather import gather_images, scatter_images
from faintspot.slopes.kernels.groups import (
    BACKGROUND,
    COMMON_ROWS,
    DENOISED,
    EXCESS,
    NO_FLUX,
    RESULT_ROWS,
    TOO_MANY_BAD_PIXELS,
    VARIANCE,
    Group,
    Scratch,
    driver_of,
)
from faintspot.slopes.kernels.host import aligned_zeros
from faintspot.slopes.kernels.positions import brightest
from faintspot.slopes.kernels.positions.brightest import gather_taps, smooth_group
from faintspot.slopes.kernels.simd import Lanes, load, splat, store, width_of
from faintspot.slopes.kernels.total_variation import denoise as total_variation
from faintspot.slopes.kernels.total_variation.denoise import denoise_group
from faintspot.slopes.kernels.total_variation.sweeps import STATE_VECTORS

_find_threshold = brightest.find_threshold
_subtract_background = brightest.subtract_background
_centre_of_gravity = brightest.centre_of_gravity
_centre_and_error = brightest.centre_and_error
_errors_of_smoothed = brightest.errors_of_smoothed
_find_largest = brightest.find_largest

INFEASIBLE_STRENGTH = int(SubapertureFlag.INFEASIBLE_STRENGTH)
NOT_CONVERGED = int(SubapertureFlag.NOT_CONVERGED)

# Rows of the settings' table that follow the common ones.
STRENGTH, TOLERANCE, LIMIT, RANK, SUBTRACT, FLOOR, LEVEL, SPREAD = range(COMMON_ROWS, COMMON_ROWS + 8)
SETTING_ROWS = COMMON_ROWS + 8


class GravityTables(NamedTuple):
    """Tables of the kernel; None, a separate type, for a step that is not compiled."""

    flat_start: Array | None = None
    """From `flat_start_table`: images are denoised."""
    algorithm: bool | None = None
    """Algorithm of the denoising, see `denoise_group`."""
    taps: Any = None
    """Taps of the smoothing along x and y, central tap first: (n_subapertures, 2, 1 + reach) float32."""


class GravityScratch(NamedTuple):
    """Memory of one thread: of the denoiser, and the lanes' values of denoiser and centroid."""

    state: Array
    """(STATE_VECTORS * pixels * W,)."""
    rows: Array
    """(`row_vectors` * W,)."""
    denoiser: Array
    """(denoise.LANE_ROWS * W,)."""
    counts: Array
    """(denoise.COUNT_ROWS * W,) int64."""
    centroid: Array


def gravity_scratch(lanes: Lanes, ny: int, nx: int) -> GravityScratch:
    """Return the kernel's own memory."""
    width, pixels = lanes.width, ny * nx
    return GravityScratch(
        aligned_zeros(STATE_VECTORS * pixels * width, lanes.dtype),
        aligned_zeros(total_variation.row_vectors(ny, nx) * width, lanes.dtype),
        aligned_zeros(total_variation.LANE_ROWS * width, lanes.dtype),
        np.zeros(total_variation.COUNT_ROWS * width, np.int64),
        aligned_zeros(brightest.LANE_ROWS * width, lanes.dtype),
    )


@compiled
def locate_gravity(group: Group, tables: GravityTables, scratch: Scratch, stages: Array) -> None:
    """Find the centres of gravity of a group; an estimator's own kernel of `groups.measure_groups`."""
    lanes, ny, nx, first, settings = group.lanes, group.ny, group.nx, group.first, group.settings
    width, own = width_of(lanes), scratch.own
    _read_settings(width, first, settings, own.denoiser, own.counts, own.centroid)
    flat_start, algorithm, taps = tables
    denoised = _first_step(flat_start, algorithm, taps, group, scratch.image, scratch.spare, own)
    if stages.shape[0] > 0:
        scatter_images(width, denoised, first, stages[DENOISED, group.frame])
    _set_threshold(lanes, denoised, ny * nx, own.centroid)
    if settings[VARIANCE, first] >= 0.0:
        _locate_with_error(taps, group, scratch.image, denoised, own)
    else:
        _centre_of_gravity(lanes, denoised, ny, nx, own.centroid)
    if stages.shape[0] > 0:
        _subtract_background(lanes, denoised, ny * nx, own.centroid, scratch.spare)
        scatter_images(width, scratch.spare, first, stages[BACKGROUND, group.frame])
    for row in range(RESULT_ROWS):
        store(scratch.results, row * width, load(lanes, own.centroid, (brightest.X + row) * width))
    for lane in range(width):
        _flag_lane(width, lane, ny, nx, first, settings, own, scratch)


@compiled
def _first_step(
    flat_start: Array | None,
    algorithm: bool | None,
    taps: Array | None,
    group: Group,
    image: Array,
    output: Array,
    own: GravityScratch,
) -> Array:
    """Denoise or smooth the images where there are tables for it; return where the result is."""
    lanes, ny, nx = group.lanes, group.ny, group.nx
    if flat_start is not None:
        lowers = True
        denoise_group(lanes, algorithm, lowers, flat_start, (ny, nx), image, output, own)
        return output
    if taps is not None:
        gather_taps(width_of(lanes), group.first, taps, own.rows)
        smooth_group(lanes, image, ny, nx, taps.shape[2] - 1, own.rows, own.state, output)
        return output
    return image


@compiled
def _locate_with_error(
    taps: Array | None, group: Group, image: Array, denoised: Array, own: GravityScratch
) -> None:
    """Write the centre of gravity of a denoised image, and its errors."""
    lanes, ny, nx = group.lanes, group.ny, group.nx
    variances, place = group.variances, group.first * ny * nx
    _centre_and_error(lanes, image, variances, place, denoised, ny, nx, own.centroid)
    if taps is not None:
        smoothing = taps.shape[2] - 1, own.rows, own.state
        _errors_of_smoothed(lanes, image, variances, place, denoised, ny, nx, smoothing, own.centroid)


@compiled
def _read_settings(
    width: int, first: int, settings: Array, denoiser: Array, counts: Array, centroid: Array
) -> None:
    """Copy the settings of the lanes' sub-apertures."""
    for lane in range(width):
        s = min(first + lane, settings.shape[1] - 1)
        denoiser[total_variation.STRENGTH * width + lane] = settings[STRENGTH, s]
        denoiser[total_variation.TOLERANCE * width + lane] = settings[TOLERANCE, s]
        counts[total_variation.LIMIT * width + lane] = int(settings[LIMIT, s])
        counts[total_variation.ITERATIONS * width + lane] = 0
        counts[total_variation.CONVERGED * width + lane] = 1
        counts[total_variation.INFEASIBLE * width + lane] = 0
        centroid[brightest.RANK * width + lane] = settings[RANK, s]
        centroid[brightest.SUBTRACT * width + lane] = settings[SUBTRACT, s]
        centroid[brightest.THRESHOLD * width + lane] = settings[LEVEL, s]
        centroid[brightest.VARIANCE * width + lane] = settings[VARIANCE, s]
        centroid[brightest.EXCESS * width + lane] = settings[EXCESS, s]
        centroid[brightest.SPREAD * width + lane] = settings[SPREAD, s]


@compiled
def _set_threshold(lanes: Lanes, image: Array, pixels: int, centroid: Array) -> None:
    """Find THRESHOLD and LARGEST; without a RANK, THRESHOLD is given."""
    if centroid[brightest.RANK * width_of(lanes)] > 0.0:
        _find_threshold(lanes, image, pixels, centroid)
    else:
        _find_largest(lanes, image, pixels, centroid)


@compiled
def _flag_lane(
    width: int,
    lane: int,
    ny: int,
    nx: int,
    first: int,
    settings: Array,
    own: GravityScratch,
    scratch: Scratch,
) -> None:
    """Write the bits of one lane's flags, and its iterations."""
    s = min(first + lane, settings.shape[1] - 1)
    counts, centroid = own.counts, own.centroid
    bits = scratch.flags[lane]
    flux, largest = centroid[brightest.SUM * width + lane], centroid[brightest.LARGEST * width + lane]
    x, y = centroid[brightest.X * width + lane], centroid[brightest.Y * width + lane]
    if not bits & TOO_MANY_BAD_PIXELS:  # else no further flags are added
        if counts[total_variation.INFEASIBLE * width + lane]:
            bits |= INFEASIBLE_STRENGTH
        if not counts[total_variation.CONVERGED * width + lane] and settings[TOLERANCE, s] > 0.0:
            bits |= NOT_CONVERGED
        # A nearly flat image leaves round-off only; negative pixels can throw a centroid out of its window.
        inside = abs(x) <= 0.5 * nx and abs(y) <= 0.5 * ny
        if not (inside and flux > settings[FLOOR, s] * largest):
            bits |= NO_FLUX
    scratch.flags[lane] = bits
    scratch.iterations[lane] = counts[total_variation.ITERATIONS * width + lane]


gravity_of_groups = driver_of(locate_gravity)


@compiled
def denoise_stack(
    lanes: Lanes,
    images: Array,
    window: tuple[int, int],
    settings: Any,
    algorithm: bool | None,
    lowers: bool,
    table: Array,
    start: int,
    stop: int,
    scratch: Scratch,
    found: Array,
) -> None:
    """Denoise the groups [start, stop) of a stack of images (n, pixels) of a window (ny, nx).

    `settings` is (3, n): strength, tolerance, limit. `found` are the denoised images, the multipliers (n,),
    and counts (3, n): iterations, converged, infeasible.
    """
    denoised, multiplier, counts_out = found
    width = width_of(lanes)
    image, output, own = scratch.image, scratch.spare, scratch.own
    denoiser, counts = own.denoiser, own.counts
    n = images.shape[0]
    for group in range(start, stop):
        first = group * width
        gather_images(width, images, first, image)
        for lane in range(width):
            s = min(first + lane, n - 1)
            denoiser[total_variation.STRENGTH * width + lane] = settings[0, s]
            denoiser[total_variation.TOLERANCE * width + lane] = settings[1, s]
            counts[total_variation.LIMIT * width + lane] = int(settings[2, s])
        denoise_group(lanes, algorithm, lowers, table, window, image, output, own)
        scatter_images(width, output, first, denoised)
        for lane in range(min(width, n - first)):
            s = first + lane
            multiplier[s] = denoiser[total_variation.MULTIPLIER * width + lane]
            counts_out[0, s] = counts[total_variation.ITERATIONS * width + lane]
            counts_out[1, s] = counts[total_variation.CONVERGED * width + lane]
            counts_out[2, s] = counts[total_variation.INFEASIBLE * width + lane]


@compiled
def subtract_stack(
    lanes: Lanes,
    images: Array,
    rank: Any,
    subtract: Any,
    start: int,
    stop: int,
    scratch: Scratch,
    result: Array,
) -> None:
    """Brightest-pixel background subtraction of the groups [start, stop) of a stack (n, pixels)."""
    width = width_of(lanes)
    image, centroid = scratch.image, scratch.own.centroid
    n, pixels = images.shape
    for group in range(start, stop):
        first = group * width
        gather_images(width, images, first, image)
        for lane in range(width):
            centroid[brightest.RANK * width + lane] = rank[min(first + lane, n - 1)]
            centroid[brightest.SUBTRACT * width + lane] = subtract
        _find_threshold(lanes, image, pixels, centroid)
        _subtract_background(lanes, image, pixels, centroid, image)
        scatter_images(width, image, first, result)


@compiled
def centroid_stack(
    lanes: Lanes, images: Array, ny: int, nx: int, start: int, stop: int, scratch: Scratch, positions: Array
) -> None:
    """Centres of gravity of the groups [start, stop) of a stack (n, pixels), into (n, 2)."""
    width = width_of(lanes)
    image, centroid = scratch.image, scratch.own.centroid
    n = images.shape[0]
    store(centroid, brightest.THRESHOLD * width, splat(lanes, -math.inf))
    store(centroid, brightest.SUBTRACT * width, splat(lanes, 0.0))
    for group in range(start, stop):
        first = group * width
        gather_images(width, images, first, image)
        _centre_of_gravity(lanes, image, ny, nx, centroid)
        for lane in range(min(width, n - first)):
            positions[first + lane, 0] = centroid[brightest.X * width + lane]
            positions[first + lane, 1] = centroid[brightest.Y * width + lane]
