"""Rows of the per-lane values (n_rows, W) that estimators of a spot's position share, and its model image."""

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
from faintspot.slopes.kernels.gravity.smoothing import variance_of, weight_variance_of

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
