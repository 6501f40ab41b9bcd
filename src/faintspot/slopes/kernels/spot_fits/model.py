"""Model of a pixel in a fit, its weight and its variance: see `likelihood`."""

from __future__ import annotations

from typing import Any

from faintspot.slopes.kernels.compilation.compiling import inlined
from faintspot.slopes.kernels.compilation.simd import (
    load,
    maximum,
    multiply_add,
    reciprocal,
    splat,
    width_of,
)
from faintspot.slopes.kernels.gravity.pixel_noise import variance_of, weight_variance_of
from faintspot.slopes.kernels.spot_fits.spot_rows import (
    EXCESS,
    MODEL_ERROR,
    VARIANCE,
    WEIGHT_EXCESS,
    WEIGHT_VARIANCE,
)


@inlined
def model_at(lanes: Any, profiles: Any, x: Any, y: Any) -> Any:
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
def noise_of(lanes: Any, lane_values: Any) -> Any:
    """Return the numbers of the lanes that `weigh` needs."""
    width = width_of(lanes)
    v, e = load(lanes, lane_values, VARIANCE * width), load(lanes, lane_values, EXCESS * width)
    wv = load(lanes, lane_values, WEIGHT_VARIANCE * width)
    we = load(lanes, lane_values, WEIGHT_EXCESS * width)
    return v, e, wv, we, load(lanes, lane_values, MODEL_ERROR * width)


@inlined
def weigh(lanes: Any, noise: Any, variances: Any, at: Any, m: Any) -> Any:
    """Return the weight w of the pixel at element `at`, of which the model is m, and w times its variance."""
    v, e, wv, we, model_error = noise
    expected = maximum(m, splat(lanes, 0.0))
    own = weight_variance_of(lanes, variances, at, v, wv)
    w = reciprocal(multiply_add(expected, multiply_add(expected, model_error, we), own))
    return w, w * multiply_add(expected, e, variance_of(lanes, variances, at, v))
