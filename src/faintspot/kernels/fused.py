"""From frames to slopes, and from stacks of images to results, group by group of W sub-apertures.

Every function here works on the groups [start, stop), so that threads can share a job; results do not
depend on how they do.
"""

from __future__ import annotations

from typing import Any

from faintspot.flags import SubapertureFlag
from faintspot.kernels import brightest, total_variation
from faintspot.kernels.compiling import compiled
from faintspot.kernels.gather import calibrate, fill_bad_pixels, gather_image, gather_raw, scatter_image
from faintspot.kernels.simd import width_of
from faintspot.kernels.total_variation import denoise_group

_find_threshold = brightest.find_threshold
_subtract_background = brightest.subtract_background
_centre_of_gravity = brightest.centre_of_gravity

NO_LIGHT = int(SubapertureFlag.NO_LIGHT)
TOO_MANY_BAD_PIXELS = int(SubapertureFlag.TOO_MANY_BAD_PIXELS)
BAD_PIXELS = int(SubapertureFlag.BAD_PIXELS)
SATURATED = int(SubapertureFlag.SATURATED)
INFEASIBLE_STRENGTH = int(SubapertureFlag.INFEASIBLE_STRENGTH)
NOT_CONVERGED = int(SubapertureFlag.NOT_CONVERGED)

# Rows of the pipeline's table of per-sub-aperture numbers (n_rows, n_subapertures), float32.
STRENGTH, TOLERANCE, LIMIT, RANK, SUBTRACT, ZERO_X, ZERO_Y, MOST_BAD, FLOOR = range(9)
SETTING_ROWS = 9

# Rows of explain's stages (n_rows, n_frames, n_subapertures, pixels).
CALIBRATED, DENOISED, BACKGROUND = range(3)
STAGE_ROWS = 3


@compiled
def slopes_of_groups(
    lanes: Any,
    frames: Any,
    corners: Any,
    ny: Any,
    nx: Any,
    calibration: Any,
    saturation: Any,
    settings: Any,
    algorithm: Any,
    start: Any,
    stop: Any,
    scratch: Any,
    slopes: Any,
    stages: Any,
) -> None:
    """Compute the slopes of the groups [start, stop) of a block of frames.

    Group g is group g % n_groups of frame g // n_groups. The last group of a frame repeats its last
    sub-aperture to fill the lanes.

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
    settings : (SETTING_ROWS, n_subapertures) float32
    algorithm : int
    scratch : tuple of arrays, from `new_scratch`
    slopes : tuple of (n_frames, n_subapertures) arrays
        x, y, flux (float32), flags (uint8), iterations, bad pixels (int32); written.
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
        f, first = item // n_groups, (item % n_groups) * width
        for lane in range(width):
            s = min(first + lane, n - 1)
            places[lane] = corners[s, 0] * frames.shape[2] + corners[s, 1]
        gather_raw(lanes, frames, f, places, ny, nx, image)
        group = item % n_groups
        calibrate(
            lanes, image, ny * nx, calibration, group * 2 * ny * nx * width, saturation, centroid_numbers
        )
        for lane in range(width):
            s = min(first + lane, n - 1)
            bad = int(centroid_numbers[lane])
            bad_counts[lane] = bad
            flags[lane] = SATURATED if centroid_numbers[width + lane] > 0.0 else 0
            if bad > 0:
                fill_bad_pixels(width, lane, ny, nx, image, output)
                flags[lane] |= TOO_MANY_BAD_PIXELS if bad > settings[MOST_BAD, s] else BAD_PIXELS
            numbers[total_variation.STRENGTH * width + lane] = settings[STRENGTH, s]
            numbers[total_variation.TOLERANCE * width + lane] = settings[TOLERANCE, s]
            counts[total_variation.LIMIT * width + lane] = int(settings[LIMIT, s])
            centroid_numbers[brightest.RANK * width + lane] = settings[RANK, s]
            centroid_numbers[brightest.SUBTRACT * width + lane] = settings[SUBTRACT, s]
        denoise_group(lanes, algorithm, ny, nx, image, output, state, rows, numbers, counts)
        if stages.shape[0] > 0:
            _store_stage(width, image, stages[CALIBRATED, f], first)
            _store_stage(width, output, stages[DENOISED, f], first)
        _locate(lanes, output, ny, nx, centroid_numbers)
        if stages.shape[0] > 0:
            _store_stage(width, output, stages[BACKGROUND, f], first)
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
def _locate(lanes: Any, image: Any, ny: Any, nx: Any, numbers: Any) -> None:
    """Background subtraction in place, and the centre of gravity."""
    _find_threshold(lanes, image, ny * nx, numbers)
    _subtract_background(lanes, image, ny * nx, numbers)
    _centre_of_gravity(lanes, image, ny, nx, numbers)


@compiled
def _store_stage(width: Any, image: Any, stage: Any, first: Any) -> None:
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
    x, y, flux, flag, iterations, bad_pixels = slopes
    total = numbers[brightest.SUM * width + lane]
    position_x, position_y = numbers[brightest.X * width + lane], numbers[brightest.Y * width + lane]
    bits = flags[lane]
    # A nearly flat image leaves round-off only; negative pixels can throw a centroid out of its window.
    lit = total > settings[FLOOR, s] * numbers[brightest.LARGEST * width + lane]
    inside = abs(position_x) <= 0.5 * nx and abs(position_y) <= 0.5 * ny
    if not bits & TOO_MANY_BAD_PIXELS:  # which says it all
        if counts[total_variation.INFEASIBLE * width + lane]:
            bits |= INFEASIBLE_STRENGTH
        if not counts[total_variation.CONVERGED * width + lane]:
            bits |= NOT_CONVERGED
        if not (lit and inside):
            bits |= NO_LIGHT
    valid = bits & (NO_LIGHT | TOO_MANY_BAD_PIXELS) == 0
    x[f, s] = position_x - settings[ZERO_X, s] if valid else 0.0
    y[f, s] = position_y - settings[ZERO_Y, s] if valid else 0.0
    flux[f, s] = total
    flag[f, s] = bits
    iterations[f, s] = counts[total_variation.ITERATIONS * width + lane]
    bad_pixels[f, s] = bad_counts[lane]


@compiled
def denoise_stack(
    lanes: Any,
    images: Any,
    ny: Any,
    nx: Any,
    settings: Any,
    algorithm: Any,
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
        denoise_group(lanes, algorithm, ny, nx, image, output, state, rows, numbers, counts)
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
        _subtract_background(lanes, image, pixels, numbers)
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
    for group in range(start, stop):
        first = group * width
        for lane in range(width):
            gather_image(width, images, min(first + lane, n - 1), lane, image)
        _centre_of_gravity(lanes, image, ny, nx, numbers)
        for lane in range(min(width, n - first)):
            positions[first + lane, 0] = numbers[brightest.X * width + lane]
            positions[first + lane, 1] = numbers[brightest.Y * width + lane]
