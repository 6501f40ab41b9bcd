"""Background of a frame that varies between the spots: haze, scattered light, broad reflections."""

from __future__ import annotations

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from faintspot.base.statistics import MAD_TO_STD

Floats = NDArray[np.float64]

_COVERED, _MOST_COVERED = 3.0, 0.42  # radius of a spot in its standard deviations; at most, in pitches
# Standard deviation of the smoothing in pitches: wings of the spots average out. At least in pixels: so does
# the noise.
_SMOOTHED, _LEAST_SMOOTHED_PX = 0.5, 6.0
_MATTERS = 0.05  # of the flux of a spot, under its noise-equivalent area
_PART = 0.02  # of the lenslets, in which it must matter
_CERTAIN = 5.0  # standard deviations


def smooth_background(frame: Floats, spots: Floats, pitch_px: float, spot_px: float) -> Floats:
    """Return the background between the spots, smoothed and continued below them.

    Pixels farther from all spots than three standard deviations of their shape are averaged with Gaussian
    weights, which leave out the others (normalised convolution, Knutsson & Westin 1993). The average of what
    is left is added, so that reflections as narrow as two pitches stay.

    Parameters
    ----------
    frame : (h, w) array
        NaN in pixels to ignore.
    spots : (n, 2) array
        x, y of the spots [px].
    pitch_px, spot_px : float
        Distance of lenslets, and standard deviation of the spot shape.
    """
    height, width = frame.shape
    column, row = np.clip(np.rint(spots).astype(np.int64), 0, (width - 1, height - 1)).T
    elsewhere = np.ones(frame.shape, bool)
    elsewhere[row, column] = False
    radius = min(max(_COVERED * spot_px, 2.0), _MOST_COVERED * pitch_px)
    usable = (scipy.ndimage.distance_transform_edt(elsewhere) > radius) & np.isfinite(frame)
    level = float(np.median(frame[usable])) if usable.any() else 0.0
    values = scipy.ndimage.median_filter(np.where(np.isfinite(frame), frame, level), 3)  # of hot pixels
    std = _smoothing_px(pitch_px)

    def smooth(image: Floats) -> Floats:
        return np.asarray(scipy.ndimage.gaussian_filter(image, std, mode="nearest"))

    weight = np.maximum(smooth(usable.astype(np.float64)), 1e-9)
    first = smooth(np.where(usable, values - level, 0.0)) / weight
    return np.asarray(level + first + smooth(np.where(usable, values - level - first, 0.0)) / weight)


def varies(frame: Floats, levels: Floats, flux: float, pitch_px: float, spot_px: float) -> bool:
    """Return whether the background differs enough between lenslets to change their slopes.

    Parameters
    ----------
    frame : (h, w) array
        Frame of which the background was taken, for its noise.
    levels : (n,) array
        Background at each lenslet.
    flux : float
        Typical flux of a spot, in the same unit.
    pitch_px, spot_px : float
        Distance of lenslets, and standard deviation of the spot shape.
    """
    differences = np.diff(frame, axis=1)
    noise = MAD_TO_STD * float(np.nanmedian(np.abs(differences))) / np.sqrt(2.0)
    # Twice smoothed, and half of the pixels used.
    certain = _CERTAIN * noise * 0.5 / _smoothing_px(pitch_px)
    matters = max(_MATTERS * flux / (4 * np.pi * spot_px**2), certain)
    return bool(np.mean(np.abs(levels - np.median(levels)) > matters) > _PART)


def _smoothing_px(pitch_px: float) -> float:
    return max(_SMOOTHED * pitch_px, _LEAST_SMOOTHED_PX)
