"""Gaussian smoothing of W sub-apertures without flux beyond the window, and noise of their pixels."""

from __future__ import annotations

from typing import Any

from faintspot.slopes.kernels.compiling import compiled
from faintspot.slopes.kernels.simd import load, maximum, multiply_add, splat, store, width_of


@compiled
def gather_taps(width: Any, first: Any, taps: Any, lane_taps: Any) -> None:
    """Put the taps (n_subapertures, 2, 1 + reach) of a group side by side: (2, 1 + reach, W)."""
    n, _, count = taps.shape
    for lane in range(width):
        s = min(first + lane, n - 1)
        for axis in range(2):
            for k in range(count):
                lane_taps[(axis * count + k) * width + lane] = taps[s, axis, k]


@compiled
def smooth_pixel(
    lanes: Any, image: Any, at: Any, step: Any, place: Any, n: Any, taps: Any, axis: Any, reach: Any
) -> Any:
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
    lanes: Any, image: Any, ny: Any, nx: Any, reach: Any, taps: Any, half_done: Any, output: Any
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


SMALLEST_VARIANCE = 1e-4
"""Electrons squared: keeps the weights finite where there is no noise."""


@compiled
def variance_of(lanes: Any, variances: Any, at: Any, mean: Any) -> Any:
    """Return the variance of the pixel at element `at`; `mean` where it is the same in all."""
    if variances is None:
        return mean
    return load(lanes, variances, at)


@compiled
def weight_variance_of(lanes: Any, variances: Any, at: Any, mean: Any, weight: Any) -> Any:
    """Return the variance that weighs the pixel at `at`; `weight` weighs a pixel of variance `mean`."""
    if variances is None:
        return weight
    own = load(lanes, variances, at)
    return maximum(own + (weight - mean), splat(lanes, SMALLEST_VARIANCE))


@compiled
def relative_variance(lanes: Any, variances: Any, at: Any, mean: Any) -> Any:
    """Return the variance of the pixel at `at` in units of `mean`, neither below the smallest."""
    if variances is None:
        return splat(lanes, 1.0)
    least = splat(lanes, SMALLEST_VARIANCE)
    return maximum(load(lanes, variances, at), least) / maximum(mean, least)


@compiled
def without_noisy_pixels(
    lanes: Any, variances: Any, place: Any, pixels: Any, mean: Any, image: Any, damped: Any
) -> Any:
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
