"""Dark level and noise of each pixel, from dark frames, and the pixels that blink or are hot."""

import math
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.statistics import MAD_TO_STD, mad_std
from faintspot.base.tables import is_map
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.camera.frame_checks import find_hot_pixels
from faintspot.slopes.sensor.layout import Layout

FEWEST_FRAMES = 10
"""Number of dark frames from which on blinking pixels are looked for."""

_OUTLYING = 3.0  # scaled median absolute deviations: variances beyond are left out of the distribution's fit
_TRIALS = 20_000  # pixels without blinking that are simulated
_SURELY = 5.0  # standard deviations below the simulated mean: one false alarm among millions of pixels
_LEAST_EXCESS = 2.0  # times the typical variance, below which blinking does not matter
_FEWEST_IN_STATE = 0.05  # fraction of the frames; a cosmic ray is no state
_BLOCK_NUMBERS = 1 << 22


class DarkPixels(NamedTuple):
    """Properties of each pixel in the dark."""

    level_adu: Floats
    """(h, w): mean."""
    noise_adu: Floats
    """(h, w): standard deviation, its square shrunk towards the typical variance."""
    blinking: NDArray[np.int64]
    """(n, 2): row and column of pixels that switch between two levels."""
    hot: NDArray[np.int64]
    """(n, 2): those that are brighter than all their neighbours."""


def dark_pixels(level: Floats, residuals: Floats) -> DarkPixels:
    """Measure each pixel.

    Parameters
    ----------
    level : (h, w) array, ADU
        Mean dark frame.
    residuals : (n, h, w) array, ADU
        Dark frames less this mean and less the drift of each frame.
    """
    variance = np.var(residuals, axis=0, ddof=1)
    shrunk, typical = shrunk_variance(variance, len(residuals) - 1)
    blinking = np.empty((0, 2), np.int64)
    if len(residuals) >= FEWEST_FRAMES:
        limit = _one_level_limit(len(residuals))
        blinking = np.argwhere((variance > _LEAST_EXCESS * typical) & (two_level_fraction(residuals) < limit))
    return DarkPixels(level, np.sqrt(shrunk), blinking, find_hot_pixels(level))


def shrunk_variance(variance: Floats, degrees: int) -> tuple[Floats, float]:
    """Shrink variances towards the typical one according to their uncertainty; return both.

    A variance of n frames is known to sqrt(2 / (n - 1)). If the true variances follow a scaled inverse
    chi-squared distribution, whose degrees of freedom and scale follow from mean and variance of the
    logarithms, the expected variance of a pixel is the mean of its own and the typical one, weighted by their
    degrees of freedom (Smyth 2004, Stat. Appl. Genet. Mol. Biol. 3, 3).

    Parameters
    ----------
    variance : array
    degrees : int
        Degrees of freedom of each.
    """
    from scipy.optimize import brentq
    from scipy.special import digamma, polygamma

    positive = variance[variance > 0]
    if positive.size == 0:
        return variance, 0.0
    logarithm = np.log(positive)
    away = np.abs(logarithm - np.median(logarithm))
    logarithm = logarithm[away <= _OUTLYING * mad_std(logarithm)]
    half_degrees = 0.5 * degrees
    centre = float(logarithm.mean()) - float(digamma(half_degrees)) + math.log(half_degrees)
    excess = float(logarithm.var()) - float(polygamma(1, half_degrees))
    limits = 0.05, 1e4  # half degrees of freedom
    if excess <= polygamma(1, limits[1]):
        typical = math.exp(centre)
        return np.full_like(variance, typical), typical
    half = brentq(lambda d: float(polygamma(1, d)) - min(excess, float(polygamma(1, limits[0]))), *limits)
    typical = math.exp(centre + float(digamma(half)) - math.log(half))
    shrunk: Floats = (half * typical + half_degrees * variance) / (half + half_degrees)
    return shrunk, typical


def two_level_fraction(residuals: Floats) -> Floats:
    """Return the smallest fraction of each pixel's variance that is left when its frames have two levels.

    Frames are sorted and split where the variance within both parts is least. Random telegraph noise leaves
    little; normal noise leaves about 1 - 2 / pi.

    Parameters
    ----------
    residuals : (n, ...) array
    """
    n, pixels = len(residuals), residuals[0].size
    flat = residuals.reshape(n, pixels)
    fewest = max(2, math.ceil(_FEWEST_IN_STATE * n))
    count = np.arange(fewest, n - fewest + 1)[:, None]
    fraction = np.empty(pixels)
    for start in range(0, pixels, max(1, _BLOCK_NUMBERS // n)):
        part = slice(start, start + max(1, _BLOCK_NUMBERS // n))
        ordered = np.sort(flat[:, part] - flat[:, part].mean(axis=0), axis=0)
        below = np.cumsum(ordered, axis=0)[count[:, 0] - 1]  # the sum above is its negative
        between = (np.square(below) * (n / (count * (n - count)))).max(axis=0)
        total = np.square(ordered).sum(axis=0)
        fraction[part] = 1.0 - between / np.maximum(total, 1e-300)
    return fraction.reshape(residuals.shape[1:])


@cache
def _one_level_limit(n: int) -> float:
    """Return the fraction below which n frames surely have two levels."""
    normal = np.random.default_rng(0).standard_normal((n, _TRIALS))
    fraction = two_level_fraction(normal)
    return float(fraction.mean() - _SURELY * fraction.std())


# Differences from the dark that count, over their scatter and the largest value.
_OTHER_DARK, _ROUNDED = 3.0, 1e-6
_FEWEST_PX = 4  # of a window's side; below, as in quad cells, no pixel shows the background only


def with_fitting_dark(
    calibration: Calibration, layout: Layout, mean: NDArray[np.float64], *, is_wide: bool
) -> tuple[Calibration, str]:
    """Move an estimated dark level to the background of some frames, if that is elsewhere; describe it.

    The background is that of the first and last rows of windows, as in the frames of the layout. A dark that
    is stated stays, but is named where it lies above the frames. Wings of wide spots are no background.

    Parameters
    ----------
    calibration : Calibration
    layout : Layout
    mean : (h, w) array
        Mean of the frames, ADU.
    is_wide : bool
        Whether the wings of spots reach the border of windows.
    """
    if calibration.dark is None or not np.isfinite(mean).any() or min(layout.window) < _FEWEST_PX:
        return calibration, ""
    edges = layout.images(mean - calibration.dark)[:, [0, -1]]
    away = float(np.nanmedian(edges))
    scatter = MAD_TO_STD * float(np.nanmedian(np.abs(edges - away)))
    wings = away > 0 and (is_wide or calibration.dark_is_known)  # or sky, where the dark is known
    if wings or abs(away) <= max(_OTHER_DARK * scatter, _ROUNDED * float(np.nanmax(np.abs(mean)))):
        return calibration, ""
    level = float(np.nanmedian(calibration.dark))
    found = f"the background of these frames is {level + away:.4g} ADU, the dark {level:.4g} ADU"
    if calibration.dark_is_known:
        return calibration, f"{found}: pixels below it have no flux; give the dark of these frames"
    moved = calibration.dark + away if is_map(calibration.dark) else float(f"{level + away:.7g}")
    return replace(calibration, dark=moved), f"{found} as estimated with the layout: the former is taken off"
