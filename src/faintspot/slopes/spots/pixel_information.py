"""Fisher information of a pixel about its mean: Poisson electrons with Gaussian read noise."""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

SMALLEST_MEAN_E = 1e-6
"""Pixels with a smaller mean [photo-electrons] count as having it."""
_LARGEST_TABLED_VARIANCE = 40.0  # above it, the expansion of the information is accurate to 5e-4
_SMALLEST_TABLED_NOISE_E = 0.05  # below it, electrons are counted without error


def poisson_gaussian_information(mean_e: Floats, read_noise_e: float) -> Floats:
    """Return the Fisher information about the mean of Poisson electrons with Gaussian read noise [1 / e-^2].

    With v = mean + read_noise^2 it tends to 1 / v + (read_noise^2 / v)^2 / (2 v^2) at large v, where the
    second term is the information in the variance, and to 1 / mean at low read noise. It is tabulated in
    between, and accurate to 5e-4.

    Parameters
    ----------
    mean_e : (...) array
        Mean electrons, from 0.
    read_noise_e : float
        Standard deviation of the read noise, from 0.
    """
    mean = np.maximum(mean_e, SMALLEST_MEAN_E)
    if read_noise_e < _SMALLEST_TABLED_NOISE_E:
        return 1 / mean
    variance = mean + read_noise_e**2
    information: Floats = 1 / variance + np.square(read_noise_e**2 / variance) / (2 * variance**2)
    low = variance < _LARGEST_TABLED_VARIANCE
    if low.any():
        spline = _information_table(read_noise_e)
        information[low] = np.exp(spline(np.log(mean[low])))
    return information


@functools.lru_cache(maxsize=64)
def _information_table(read_noise_e: float) -> Any:
    """Return a spline of the logarithm of the information against the logarithm of the mean.

    p(g) is a sum over electrons k of Poisson(k) Normal(g - k). Since d Poisson(k) / d mean is
    Poisson(k - 1) - Poisson(k), dp/dmean = p(g - 1) - p(g), and the information, the integral of its square
    over p, is the integral of p(g - 1)^2 / p(g), minus 1.
    """
    from scipy.interpolate import CubicSpline
    from scipy.special import gammaln

    log_mean = np.linspace(math.log(SMALLEST_MEAN_E), math.log(_LARGEST_TABLED_VARIANCE), 160)
    mean = np.exp(log_mean)
    per_electron = math.ceil(8 / min(read_noise_e, 1.0))  # samples: the integrand is smooth at this step
    highest = _LARGEST_TABLED_VARIANCE + 10 * math.sqrt(_LARGEST_TABLED_VARIANCE) + 10 * read_noise_e
    lowest = -math.ceil(10 * read_noise_e) - 1
    values = np.arange(lowest * per_electron, math.ceil(highest) * per_electron) / per_electron
    # More electrons than the largest value, so that p does not end before the range of integration.
    electrons = np.arange(math.ceil(highest + 10 * read_noise_e) + 3)
    poisson = np.exp(electrons * log_mean[:, None] - mean[:, None] - gammaln(electrons + 1))
    normal = np.exp(-0.5 * np.square((values - electrons[:, None]) / read_noise_e))
    density = poisson @ normal / (read_noise_e * math.sqrt(2 * math.pi))
    before, after = density[:, :-per_electron], density[:, per_electron:]
    ratio = np.divide(before, after, out=np.zeros_like(before), where=after > 1e-280)
    information = np.sum(np.square(ratio - 1) * after, axis=1) / per_electron
    return CubicSpline(log_mean, np.log(information))
