"""Steps of the centre of gravity on their own, for stacks of images (n, pixels): groups [start, stop)."""

from __future__ import annotations

import math
from typing import Any

from faintspot.slopes.kernels.compilation.compiling import compiled
from faintspot.slopes.kernels.compilation.simd import splat, store, width_of
from faintspot.slopes.kernels.driver.gather import gather_images, scatter_images
from faintspot.slopes.kernels.gravity import brightest
from faintspot.slopes.kernels.total_variation import denoise as total_variation
from faintspot.slopes.kernels.total_variation.denoise import denoise_group

_find_threshold = brightest.find_threshold
_subtract_background = brightest.subtract_background
_centre_of_gravity = brightest.centre_of_gravity


@compiled
def denoise_stack(
    lanes: Any,
    images: Any,
    ny: Any,
    nx: Any,
    settings: Any,
    algorithm: Any,
    lowers: Any,
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
        denoise_group(
            lanes, algorithm, lowers, table, ny, nx, image, output, own.state, own.rows, denoiser, counts
        )
        scatter_images(width, output, first, denoised)
        for lane in range(min(width, n - first)):
            s = first + lane
            multiplier[s] = denoiser[total_variation.MULTIPLIER * width + lane]
            counts_out[0, s] = counts[total_variation.ITERATIONS * width + lane]
            counts_out[1, s] = counts[total_variation.CONVERGED * width + lane]
            counts_out[2, s] = counts[total_variation.INFEASIBLE * width + lane]


@compiled
def subtract_stack(
    lanes: Any, images: Any, rank: Any, subtract: Any, start: Any, stop: Any, scratch: Any, result: Any
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
    lanes: Any, images: Any, ny: Any, nx: Any, start: Any, stop: Any, scratch: Any, positions: Any
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
