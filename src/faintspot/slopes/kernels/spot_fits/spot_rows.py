"""Rows of the table of per-lane values (n_rows, W) that the estimators of a spot's position share."""

from __future__ import annotations

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
