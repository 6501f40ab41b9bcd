"""Variance of the pixels in the dark, where it differs from pixel to pixel: read noise of CMOS cameras.

Variances are (n_groups, pixels, W), and those of a group begin at element `place`. They are None where one
number holds for a whole sub-aperture: kernels are then compiled without them.
"""

from __future__ import annotations

from typing import Any

from faintspot.slopes.kernels.compilation.compiling import compiled
from faintspot.slopes.kernels.compilation.simd import load, maximum, splat, store, width_of

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
