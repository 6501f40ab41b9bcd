"""Centroid gain: how far a slope moves when a spot moves by one pixel, measured by moving the spots."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import finite_array
from faintspot.base.errors import InputError
from faintspot.slopes.pipeline.slopes import Slopes

Floats = NDArray[np.float64]

_BLOCKS = 20  # of frames, whose scatter says the error: noise and turbulence are correlated for shorter
_FEWEST_FRAMES = 2 * _BLOCKS


@dataclass(frozen=True)
class CentroidGain:
    """Slope per pixel of displacement, along x and y."""

    gain: Floats
    """(n, 2)"""
    standard_error: Floats
    """(n, 2)"""

    @property
    def mean(self) -> tuple[float, float]:
        """Mean over sub-apertures and axes, each counting by its error, and its standard error."""
        usable = np.isfinite(self.standard_error) & (self.standard_error > 0)
        if not usable.any():
            return float(self.gain.mean()), 0.0
        weight = self.standard_error[usable] ** -2.0
        return float((weight * self.gain[usable]).sum() / weight.sum()), float(weight.sum() ** -0.5)


def measure_centroid_gain(slopes: Slopes | ArrayLike, displacement_px: ArrayLike) -> CentroidGain:
    """Return the centroid gain of every sub-aperture from frames in which the spots were moved.

    The regression of slopes on displacements that are known: a dither of tip and tilt, or what recorded
    commands move the spots by (the interaction matrix at a gain of 1 times the commands). What moves the
    spots beside that, and noise, must not follow the same course: dither at a frequency of its own. Quad
    cells, whose gain follows the size of the spot, are calibrated so.

    Parameters
    ----------
    slopes : Slopes of several frames, or (n_frames, 2 n) array
        All x, then all y, px.
    displacement_px : (n_frames, 2) or (n_frames, 2 n) array
        Of all spots along x and y, or of each, px.

    Returns
    -------
    CentroidGain
        Its errors are from the scatter of the result among 20 stretches of frames.

    Raises
    ------
    InputError
        For fewer than 40 frames, arrays that do not fit together, or spots that were not moved.

    Examples
    --------
    >>> import numpy as np
    >>> from faintspot.slopes.training import measure_centroid_gain
    >>> dither = 0.1 * np.sin(2 * np.pi * 0.13 * np.arange(400))[:, None] * [1.0, 1.0]
    >>> noise = np.random.default_rng(1).normal(0.0, 0.02, (400, 6))
    >>> slopes = 0.7 * np.repeat(dither, 3, axis=1) + noise
    >>> print(measure_centroid_gain(slopes, dither).gain.round(1))
    [[0.7 0.7]
     [0.7 0.7]
     [0.7 0.7]]
    """
    measured = finite_array("slopes", slopes.vector if isinstance(slopes, Slopes) else slopes)
    moved = finite_array("displacement_px", displacement_px).astype(np.float64)
    if measured.ndim != 2 or measured.shape[1] % 2 or len(measured) < _FEWEST_FRAMES:
        raise InputError(
            f"slopes: expected (n_frames, 2 n) with at least {_FEWEST_FRAMES} frames, got {measured.shape}"
        )
    n = measured.shape[1] // 2
    if moved.shape == (len(measured), 2):
        moved = np.repeat(moved, n, axis=1)
    if moved.shape != measured.shape:
        raise InputError(
            f"displacement_px: expected shape ({len(measured)}, 2) or {measured.shape}, got {moved.shape}"
        )
    moved = moved - moved.mean(axis=0)
    square = (moved**2).sum(axis=0)
    if np.any(square <= 0):
        raise InputError("displacement_px: expected all spots to move along x and y, some stand still")
    slopes_about_mean = measured - measured.mean(axis=0)
    gain = (slopes_about_mean * moved).sum(axis=0) / square
    residual = (slopes_about_mean - gain * moved) * moved
    parts = np.stack([part.sum(axis=0) for part in np.array_split(residual, _BLOCKS)])
    error = parts.std(axis=0, ddof=1) * math.sqrt(_BLOCKS) / square
    return CentroidGain(gain.reshape(2, n).T, error.reshape(2, n).T)
