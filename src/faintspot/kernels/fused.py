"""From frames to slopes, and from stacks of images to results, group by group of W sub-apertures.

Every function here works on the groups [start, stop), so that threads can share a job; results do not
depend on how they do.
"""

from __future__ import annotations

import math
from typing import Any

from faintspot.flags import SubapertureFlag
from faintspot.kernels import brightest, total_variation
from faintspot.kernels.compiling import compiled
from faintspot.kernels.gather import calibrate, fill_bad_pixels, gather_image, gather_raw, scatter_image
from faintspot.kernels.simd import load, select, splat, store, width_of
from faintspot.kernels.smoothing import gather_taps, smooth_group
from faintspot.kernels.total_variation import denoise_group

_find_threshold = brightest.find_threshold
_subtract_background = brightest.subtract_background
_centre_of_gravity = brightest.centre_of_gravity
_centre_and_error = brightest.centre_and_error
_find_largest = brightest.find_largest

NO_LIGHT = int(SubapertureFlag.NO_LIGHT)
TOO_MANY_BAD_PIXELS = int(SubapertureFlag.TOO_MANY_BAD_PIXELS)
BAD_PIXELS = int(SubapertureFlag.BAD_PIXELS)
SATURATED = int(SubapertureFlag.SATURATED)
INFEASIBLE_STRENGTH = int(SubapertureFlag.INFEASIBLE_STRENGTH)
NOT_CONVERGED = int(SubapertureFlag.NOT_CONVERGED)

# Rows of the pipeline's table of per-sub-aperture numbers (n_rows, n_subapertures), float32.
# All estimators: reference position and how far from it a position may be; bad pixels; noise of a pixel that
# collects m electrons, VARIANCE + EXCESS m (negative where unknown); factor on the standard error.
ZERO_X, ZERO_Y, RANGE, MOST_BAD, VARIANCE, EXCESS, ERROR_SCALE = range(7)
# Centre of gravity.
STRENGTH, TOLERANCE, LIMIT, RANK, SUBTRACT, FLOOR, LEVEL = range(7, 14)
# Estimators that know the spot: see `located`.
FLUX, WEIGHT_FLOOR, WEIGHT_EXCESS, MODEL_ERROR, PRIOR_WEIGHT = range(14, 19)
MODEL, KIND, START_LIGHT, GAIN_X, GAIN_Y, TRAINED_ERROR_X, TRAINED_ERROR_Y, LEAST_LIGHT = range(19, 27)
SETTING_ROWS = 27

# What is done before the background subtraction, and what takes the background off.
NOTHING, SMOOTH, DENOISE = range(3)

# Rows of explain's stages (n_rows, n_frames, n_subapertures, pixels).
CALIBRATED, DENOISED, BACKGROUND = range(3)
STAGE_ROWS = 3


@compiled
def prepare_group(
    lanes: Any,
    frames: Any,
    f: Any,
    group: Any,
    corners: Any,
    ny: Any,
    nx: Any,
    calibration: Any,
    saturation: Any,
    settings: Any,
    image: Any,
    spare: Any,
    places: Any,
    flags: Any,
    bad_counts: Any,
    numbers: Any,
) -> None:
    """Gather and calibrate the W sub-apertures of a group, fill bad pixels and flag what there is to flag.

    The last group of a frame repeats its last sub-aperture to fill the lanes. `spare` holds ny * nx * W
    and `numbers` 2 * W numbers of scratch; for the others see `slopes_of_groups`.
    """
    width = width_of(lanes)
    n, first = corners.shape[0], group * width
    for lane in range(width):
        s = min(first + lane, n - 1)
        places[lane] = corners[s, 0] * frames.shape[2] + corners[s, 1]
    gather_raw(lanes, frames, f, places, ny, nx, spare, image)
    calibrate(lanes, image, ny * nx, calibration, group * 2 * ny * nx * width, saturation, numbers)
    for lane in range(width):
        s = min(first + lane, n - 1)
        bad = int(numbers[lane])
        bad_counts[lane] = bad
        flags[lane] = SATURATED if numbers[width + lane] > 0.0 else 0
        if bad > 0:
            fill_bad_pixels(width, lane, ny, nx, image, spare)
            flags[lane] |= TOO_MANY_BAD_PIXELS if bad > settings[MOST_BAD, s] else BAD_PIXELS


@compiled
def slopes_of_groups(
    lanes: Any,
    frames: Any,
    corners: Any,
    ny: Any,
    nx: Any,
    calibration: Any,
    saturation: Any,
    tables: Any,
    variants: Any,
    before: Any,
    algorithm: Any,
    table: Any,
    taps: Any,
    start: Any,
    stop: Any,
    scratch: Any,
    slopes: Any,
    stages: Any,
) -> None:
    """Compute the slopes of the groups [start, stop) of a block of frames, as centres of gravity.

    Group g is group g % n_groups of frame g // n_groups.

    Parameters
    ----------
    lanes : Lanes
    frames : (n_frames, h, w) uint16 or float32
    corners : (n_subapertures, 2) int64
        Row and column of every window's first pixel.
    ny, nx : int
        Window.
    calibration : (n_groups, pixels, 2, W) float32
        Dark in ADU, and electrons per ADU (NaN in bad pixels); all lanes of a pixel together.
    saturation : float
        In ADU.
    tables : (n_variants, SETTING_ROWS, n_subapertures) float32
        Settings.
    variants : (n_frames,) int64
        Which of these tables a frame is measured with.
    before : int
        NOTHING, SMOOTH or DENOISE.
    algorithm, table
        Of the denoising, see `denoise_group`.
    taps : (n_subapertures, 2, 1 + reach) float32
        Of the smoothing along x and y, the central one first.
    scratch : tuple of arrays, from `new_scratch`
    slopes : tuple of (n_frames, n_subapertures) arrays
        x, y, flux (float32), flags (uint8), iterations, bad pixels (int32), standard errors of x and y
        (float32); written.
    stages : (STAGE_ROWS or 0, n_frames, n_subapertures, pixels) float32
        Written where it has rows.
    """
    width = width_of(lanes)
    image, output, state, rows, numbers, counts, lane_counts = scratch
    places, flags, bad_counts = lane_counts[:width], lane_counts[width : 2 * width], lane_counts[2 * width :]
    # The centroid's numbers follow the denoiser's in one table.
    centroid_numbers = numbers[total_variation.LANE_ROWS * width :]
    n = corners.shape[0]
    n_groups = (n + width - 1) // width
    for item in range(start, stop):
        f, group = item // n_groups, item % n_groups
        first = group * width
        settings = tables[variants[f]]
        prepare_group(
            lanes,
            frames,
            f,
            group,
            corners,
            ny,
            nx,
            calibration,
            saturation,
            settings,
            image,
            output,
            places,
            flags,
            bad_counts,
            centroid_numbers,
        )
        _read_settings(width, first, settings, numbers, counts, centroid_numbers)
        denoised = output
        if before == DENOISE:
            denoise_group(lanes, algorithm, table, ny, nx, image, output, state, rows, numbers, counts)
        elif before == SMOOTH:
            gather_taps(width, first, taps, rows)
            smooth_group(lanes, image, ny, nx, taps.shape[2] - 1, rows, state, output)
        else:
            denoised = image
        if stages.shape[0] > 0:
            store_stage(width, image, stages[CALIBRATED, f], first)
            store_stage(width, denoised, stages[DENOISED, f], first)
        _set_threshold(lanes, denoised, ny * nx, centroid_numbers)
        if settings[VARIANCE, first] >= 0.0:
            _centre_and_error(lanes, image, denoised, ny, nx, centroid_numbers)
        else:
            _centre_of_gravity(lanes, denoised, ny, nx, centroid_numbers)
        if stages.shape[0] > 0:
            _subtract_background(lanes, denoised, ny * nx, centroid_numbers, output)
            store_stage(width, output, stages[BACKGROUND, f], first)
        for lane in range(min(width, n - first)):
            _store_slope(
                width,
                ny,
                nx,
                lane,
                f,
                first + lane,
                settings,
                centroid_numbers,
                counts,
                flags,
                bad_counts,
                slopes,
            )


@compiled
def _read_settings(
    width: Any, first: Any, settings: Any, numbers: Any, counts: Any, centroid_numbers: Any
) -> None:
    """Copy what the lanes' sub-apertures are set to."""
    for lane in range(width):
        s = min(first + lane, settings.shape[1] - 1)
        numbers[total_variation.STRENGTH * width + lane] = settings[STRENGTH, s]
        numbers[total_variation.TOLERANCE * width + lane] = settings[TOLERANCE, s]
        counts[total_variation.LIMIT * width + lane] = int(settings[LIMIT, s])
        counts[total_variation.ITERATIONS * width + lane] = 0
        counts[total_variation.CONVERGED * width + lane] = 1
        counts[total_variation.INFEASIBLE * width + lane] = 0
        centroid_numbers[brightest.RANK * width + lane] = settings[RANK, s]
        centroid_numbers[brightest.SUBTRACT * width + lane] = settings[SUBTRACT, s]
        centroid_numbers[brightest.THRESHOLD * width + lane] = settings[LEVEL, s]
        centroid_numbers[brightest.VARIANCE * width + lane] = settings[VARIANCE, s]
        centroid_numbers[brightest.EXCESS * width + lane] = settings[EXCESS, s]


@compiled
def _set_threshold(lanes: Any, image: Any, pixels: Any, numbers: Any) -> None:
    """Find THRESHOLD and LARGEST; without a RANK, THRESHOLD is given."""
    if numbers[brightest.RANK * width_of(lanes)] > 0.0:
        _find_threshold(lanes, image, pixels, numbers)
    else:
        _find_largest(lanes, image, pixels, numbers)


@compiled
def store_stage(width: Any, image: Any, stage: Any, first: Any) -> None:
    """Copy a group's images to where `explain` collects them."""
    for lane in range(min(width, stage.shape[0] - first)):
        scatter_image(width, image, lane, stage, first + lane)


@compiled
def _store_slope(
    width: Any,
    ny: Any,
    nx: Any,
    lane: Any,
    f: Any,
    s: Any,
    settings: Any,
    numbers: Any,
    counts: Any,
    flags: Any,
    bad_counts: Any,
    slopes: Any,
) -> None:
    """Write one sub-aperture's result; the reference position (slope 0) where it is invalid."""
    bits = flags[lane]
    if not bits & TOO_MANY_BAD_PIXELS:  # which says it all
        if counts[total_variation.INFEASIBLE * width + lane]:
            bits |= INFEASIBLE_STRENGTH
        if not counts[total_variation.CONVERGED * width + lane] and settings[TOLERANCE, s] > 0.0:
            bits |= NOT_CONVERGED
    slopes[4][f, s] = counts[total_variation.ITERATIONS * width + lane]
    slopes[5][f, s] = bad_counts[lane]
    store_centroid(
        ny,
        nx,
        f,
        s,
        settings,
        bits,
        numbers[brightest.SUM * width + lane],
        numbers[brightest.LARGEST * width + lane],
        numbers[brightest.X * width + lane],
        numbers[brightest.Y * width + lane],
        numbers[brightest.ERROR_X * width + lane],
        numbers[brightest.ERROR_Y * width + lane],
        slopes,
    )


@compiled
def store_centroid(
    ny: Any,
    nx: Any,
    f: Any,
    s: Any,
    settings: Any,
    bits: Any,
    total: Any,
    largest: Any,
    position_x: Any,
    position_y: Any,
    deviation_x: Any,
    deviation_y: Any,
    slopes: Any,
) -> None:
    """Write position, flux, flags and standard errors of one sub-aperture; the reference where invalid."""
    x, y, flux, flag, _, _, error_x, error_y = slopes
    # A nearly flat image leaves round-off only; negative pixels can throw a centroid out of its window.
    lit = total > settings[FLOOR, s] * largest
    inside = abs(position_x) <= 0.5 * nx and abs(position_y) <= 0.5 * ny
    if not (bits & TOO_MANY_BAD_PIXELS or (lit and inside)):
        bits |= NO_LIGHT
    valid = bits & (NO_LIGHT | TOO_MANY_BAD_PIXELS) == 0
    reach = settings[RANGE, s]
    x[f, s] = within(position_x - settings[ZERO_X, s], reach) if valid else 0.0
    y[f, s] = within(position_y - settings[ZERO_Y, s], reach) if valid else 0.0
    known = valid and settings[VARIANCE, s] >= 0.0
    scale = settings[ERROR_SCALE, s]
    error_x[f, s] = scale * deviation_x if known else math.inf
    error_y[f, s] = scale * deviation_y if known else math.inf
    flux[f, s] = total
    flag[f, s] = bits


@compiled
def within(slope: Any, reach: Any) -> Any:
    """Keep a slope within the allowed range."""
    return min(max(slope, -reach), reach)


@compiled
def light_of_groups(
    lanes: Any,
    frames: Any,
    corners: Any,
    ny: Any,
    nx: Any,
    calibration: Any,
    saturation: Any,
    start: Any,
    stop: Any,
    scratch: Any,
    light: Any,
) -> None:
    """Sum the pixels of every sub-aperture, electrons, bad ones as 0; parameters as `slopes_of_groups`."""
    width = width_of(lanes)
    image, block, _, _, numbers, _, lane_counts = scratch
    n = corners.shape[0]
    n_groups = (n + width - 1) // width
    for item in range(start, stop):
        f, group = item // n_groups, item % n_groups
        for lane in range(width):
            s = min(group * width + lane, n - 1)
            lane_counts[lane] = corners[s, 0] * frames.shape[2] + corners[s, 1]
        gather_raw(lanes, frames, f, lane_counts, ny, nx, block, image)
        calibrate(lanes, image, ny * nx, calibration, group * 2 * ny * nx * width, saturation, numbers)
        total, zero = splat(lanes, 0.0), splat(lanes, 0.0)
        for i in range(ny * nx):
            g = load(lanes, image, i * width)
            total = total + select(g >= g, g, zero)
        store(numbers, 0, total)
        for lane in range(min(width, n - group * width)):
            light[f, group * width + lane] = numbers[lane]


@compiled
def denoise_stack(
    lanes: Any,
    images: Any,
    ny: Any,
    nx: Any,
    settings: Any,
    algorithm: Any,
    table: Any,
    start: Any,
    stop: Any,
    scratch: Any,
    denoised: Any,
    multiplier: Any,
    counts_out: Any,
) -> None:
    """Denoise the groups [start, stop) of a stack of images (n, pixels).

    `settings` is (3, n): strength, tolerance, limit; `counts_out` (3, n): iterations, converged, infeasible.
    """
    width = width_of(lanes)
    image, output, state, rows, numbers, counts, _ = scratch
    n = images.shape[0]
    for group in range(start, stop):
        first = group * width
        for lane in range(width):
            s = min(first + lane, n - 1)
            gather_image(width, images, s, lane, image)
            numbers[total_variation.STRENGTH * width + lane] = settings[0, s]
            numbers[total_variation.TOLERANCE * width + lane] = settings[1, s]
            counts[total_variation.LIMIT * width + lane] = int(settings[2, s])
        denoise_group(lanes, algorithm, table, ny, nx, image, output, state, rows, numbers, counts)
        for lane in range(min(width, n - first)):
            s = first + lane
            scatter_image(width, output, lane, denoised, s)
            multiplier[s] = numbers[total_variation.MULTIPLIER * width + lane]
            counts_out[0, s] = counts[total_variation.ITERATIONS * width + lane]
            counts_out[1, s] = counts[total_variation.CONVERGED * width + lane]
            counts_out[2, s] = counts[total_variation.INFEASIBLE * width + lane]


@compiled
def subtract_stack(
    lanes: Any, images: Any, rank: Any, subtract: Any, start: Any, stop: Any, scratch: Any, result: Any
) -> None:
    """Brightest-pixel background subtraction of the groups [start, stop) of a stack (n, pixels)."""
    width = width_of(lanes)
    image, _, _, _, numbers, _, _ = scratch
    n, pixels = images.shape
    for group in range(start, stop):
        first = group * width
        for lane in range(width):
            s = min(first + lane, n - 1)
            gather_image(width, images, s, lane, image)
            numbers[brightest.RANK * width + lane] = rank[s]
            numbers[brightest.SUBTRACT * width + lane] = subtract
        _find_threshold(lanes, image, pixels, numbers)
        _subtract_background(lanes, image, pixels, numbers, image)
        for lane in range(min(width, n - first)):
            scatter_image(width, image, lane, result, first + lane)


@compiled
def centroid_stack(
    lanes: Any, images: Any, ny: Any, nx: Any, start: Any, stop: Any, scratch: Any, positions: Any
) -> None:
    """Centres of gravity of the groups [start, stop) of a stack (n, pixels), into (n, 2)."""
    width = width_of(lanes)
    image, _, _, _, numbers, _, _ = scratch
    n = images.shape[0]
    store(numbers, brightest.THRESHOLD * width, splat(lanes, -math.inf))
    store(numbers, brightest.SUBTRACT * width, splat(lanes, 0.0))
    for group in range(start, stop):
        first = group * width
        for lane in range(width):
            gather_image(width, images, min(first + lane, n - 1), lane, image)
        _centre_of_gravity(lanes, image, ny, nx, numbers)
        for lane in range(min(width, n - first)):
            positions[first + lane, 0] = numbers[brightest.X * width + lane]
            positions[first + lane, 1] = numbers[brightest.Y * width + lane]
