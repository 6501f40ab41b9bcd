"""Noise of slopes: variances of all slopes; x and y of a sub-aperture independent or with a covariance."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

LARGEST_CORRELATION = 0.99  # of x and y: a narrower ellipse is not known from one frame


def add_noise(matrix_px2: Floats, variance_px2: Floats, covariance_xy_px2: Floats | None = None) -> None:
    """Add the covariance matrix of the slopes' noise, in place.

    Parameters
    ----------
    matrix_px2 : (2 n, 2 n) array
        All x, then all y; written.
    variance_px2 : (2 n,) array
    covariance_xy_px2 : (n,) array, optional
        Covariance of x and y of each sub-aperture. Default: 0.
    """
    every = np.arange(len(matrix_px2))
    matrix_px2[every, every] += variance_px2
    if covariance_xy_px2 is not None:
        x, y = np.split(every, 2)
        matrix_px2[x, y] += covariance_xy_px2
        matrix_px2[y, x] += covariance_xy_px2


def weighted_slopes(slopes: Floats, variance_px2: Floats, covariance_xy_px2: Floats | None = None) -> Floats:
    """Return the product of the inverse covariance matrix of the noise and columns of slopes, (2 n, k).

    Parameters
    ----------
    slopes : (2 n, k) array
    variance_px2 : (2 n,) array
        A slope whose variance is 0, infinite or NaN has no weight.
    covariance_xy_px2 : (n,) array, optional
        As for `add_noise`; correlations above 0.99 count as 0.99.
    """
    measured = np.isfinite(variance_px2) & (variance_px2 > 0)
    root = np.where(measured, 1 / np.sqrt(np.where(measured, variance_px2, 1.0)), 0.0)[:, None]
    scaled = root * slopes
    if covariance_xy_px2 is not None:
        (of_x, of_y), (x, y) = np.split(root, 2), np.split(scaled, 2)
        rho = np.clip(covariance_xy_px2[:, None] * of_x * of_y, -LARGEST_CORRELATION, LARGEST_CORRELATION)
        scaled = np.concatenate([x - rho * y, y - rho * x]) / np.tile(1 - rho**2, (2, 1))
    weighted: Floats = root * scaled
    return weighted
