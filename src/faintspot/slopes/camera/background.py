"""Background of a frame that varies between the spots: haze, scattered light, broad reflections."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.fft
import scipy.ndimage
from numpy.typing import NDArray

from faintspot.base.statistics import MAD_TO_STD

Floats = NDArray[np.float64]

_WIDTHS, _ROUNDS = np.geomspace(0.7, 1.4, 29), 3  # of spots that overlap, over the width first taken
_COVERED, _MOST_COVERED = 3.0, 0.42  # radius of a spot in its standard deviations; at most, in pitches
# Standard deviation of the smoothing in pitches: wings of the spots average out. At least in pixels: so does
# the noise.
_SMOOTHED, _LEAST_SMOOTHED_PX = 0.5, 6.0
# Of the flux of a spot, under its noise-equivalent area; wings of spots that overlap are known no better.
_MATTERS, _MATTERS_BELOW_WINGS = 0.05, 0.1
_PART = 0.02  # of the lenslets, in which it must matter
_CERTAIN = 5.0  # standard deviations


def overlap(pitch_px: float, spot_px: float) -> bool:
    """Return whether the wings of spots of this standard deviation reach those of their neighbours."""
    return _COVERED * spot_px > _MOST_COVERED * pitch_px


def smooth_background(frame: Floats, spots: Floats, pitch_px: float, spot_px: float) -> Floats:
    """Return the background between the spots, smoothed and continued below them.

    Pixels farther from all spots than three standard deviations of their shape are averaged with Gaussian
    weights, which leave out the others (normalised convolution, Knutsson & Westin 1993). The average of what
    is left is added, so that reflections as narrow as two pitches stay. Spots so wide that they overlap are
    taken off first, as Gaussians of their height above the background: else their wings would be part of it.

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
    at = row, column
    elsewhere = np.ones(frame.shape, bool)
    elsewhere[at] = False
    radius = min(max(_COVERED * spot_px, 2.0), _MOST_COVERED * pitch_px)
    usable = (scipy.ndimage.distance_transform_edt(elsewhere) > radius) & np.isfinite(frame)
    level = float(np.median(frame[usable])) if usable.any() else 0.0
    values = scipy.ndimage.median_filter(np.where(np.isfinite(frame), frame, level), 3)  # of hot pixels
    std = _smoothing_px(pitch_px)

    def smooth(image: Floats) -> Floats:
        return np.asarray(scipy.ndimage.gaussian_filter(image, std, mode="nearest"))

    weight = np.maximum(smooth(usable.astype(np.float64)), 1e-9)

    def background(image: Floats) -> Floats:
        first = smooth(np.where(usable, image - level, 0.0)) / weight
        return np.asarray(level + first + smooth(np.where(usable, image - level - first, 0.0)) / weight)

    if not overlap(pitch_px, spot_px):
        return background(values)
    spot_px, flat = _overlapping_width(values, at, spot_px)
    found = np.full(frame.shape, flat)
    for _ in range(_ROUNDS):
        found = background(values - _gaussians(frame.shape, at, values[at] - found[at], spot_px))
    return found


def _overlapping_width(frame: Floats, at: tuple[Any, Any], spot_px: float) -> tuple[float, float]:
    """Return standard deviation and even background of Gaussians with the frame's values at their middles."""
    ones, heights, places = np.ones(frame.shape), np.zeros(frame.shape), np.zeros(frame.shape)
    np.add.at(heights, at, frame[at])
    np.add.at(places, at, 1.0)
    spectra = scipy.fft.rfft2(np.stack([frame, ones, heights, places]))
    squares = scipy.fft.fftfreq(len(frame))[:, None] ** 2 + scipy.fft.rfftfreq(frame.shape[1]) ** 2
    fits = []
    for width in spot_px * _WIDTHS:
        spot = 2 * np.pi * width**2 * np.exp(-2 * (np.pi * width) ** 2 * squares)
        rest, shown = spectra[:2] - spot * spectra[2:]
        level = float(np.vdot(shown, rest).real / np.vdot(shown, shown).real)
        fits.append((float(np.square(np.abs(rest - level * shown)).sum()), float(width), level))
    return min(fits)[1:]


def _gaussians(shape: tuple[int, ...], at: tuple[Any, Any], heights: Floats, width_px: float) -> Floats:
    """Return the sum of Gaussians of these heights at rows and columns."""
    image = np.zeros(shape)
    np.add.at(image, at, heights)
    smoothed = scipy.ndimage.gaussian_filter(image, width_px, mode="constant")
    return np.asarray(2 * np.pi * width_px**2 * smoothed)


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
    part = _MATTERS_BELOW_WINGS if overlap(pitch_px, spot_px) else _MATTERS
    matters = max(part * flux / (4 * np.pi * spot_px**2), certain)
    return bool(np.mean(np.abs(levels - np.median(levels)) > matters) > _PART)


def _smoothing_px(pitch_px: float) -> float:
    return max(_SMOOTHED * pitch_px, _LEAST_SMOOTHED_PX)
