"""Fried parameter from differential image motion, the estimate of seeing monitors."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from faintspot.loop.turbulence.slope_covariance import SlopeTurbulence
from faintspot.loop.turbulence.strength import sampled
from faintspot.slopes.spots.von_karman import R0_WAVELENGTH_M

Floats = NDArray[np.float64]

_APART = (1.5, 3.5)  # sub-apertures: nearer ones see the same tilt, in farther ones the outer scale shows
_SQUARES = 0.02  # of r0: a square is not quite a disc of its area


def differential_image_motion(
    atmosphere_px: Floats, noise_px2: Floats, site: SlopeTurbulence, frame_rate_hz: float
) -> tuple[float, float]:
    """Return r0 at 500 nm and its standard error, m; NaN if the slopes vary no more than their noise.

    Tip and tilt, vibrations included, cancel in differences. An infinite outer scale is assumed: one of 10 m
    makes r0 14 % too large with sub-apertures of 0.6 m, one of 25 m 4 %. The error follows from how much
    of the turbulence has crossed the pupil, see `faintspot.loop.turbulence.strength.sampled`.

    Parameters
    ----------
    atmosphere_px : (frames, 2 n) array
        Open-loop slopes: all x, then all y; centres of gravity.
    noise_px2 : (2 n,) array
        Variance of their noise.
    site : SlopeTurbulence
        Geometry, with `averaged`, and winds; its strength is not used.
    frame_rate_hz : float

    Notes
    -----
    Sarazin & Roddier 1990 (A&A 227, 294), with the coefficients of Tokovinin 2002 (PASP 114, 1156, eq. 8) for
    centres of gravity, of pairs of sub-apertures two or three apart along a row or a column.
    """
    first, second, expected = _pairs(site)
    if not len(first):
        return math.nan, math.nan
    noise = float((noise_px2[first] + noise_px2[second]).sum())
    # (scale / wavelength)^2 sum of variances = sum of coefficients D^(-1/3) r0^(-5/3)
    unit = (site.pixel_scale_rad / R0_WAVELENGTH_M) ** 2 / expected

    pairs = np.eye(len(noise_px2))[first] - np.eye(len(noise_px2))[second]
    apart = atmosphere_px[:, first] - atmosphere_px[:, second]
    lost, variance = sampled([pairs.T], site, len(atmosphere_px) / frame_rate_hz)
    strength = unit * (float(apart.var(axis=0).sum()) - noise) / (1 - float(lost[0]))
    if not strength > 0:
        return math.nan, math.nan
    r0 = strength ** (-3 / 5)
    return r0, r0 * math.hypot(3 / 5 * math.sqrt(float(variance[0, 0])), _SQUARES)


def _pairs(site: SlopeTurbulence) -> tuple[NDArray[np.int64], NDArray[np.int64], float]:
    """Return the slopes of pairs, and the sum of their coefficients times D^(-1/3)."""
    n, side = len(site.positions_m), site.subaperture_m
    disc_m = site.averaged * side * math.sqrt(4 / math.pi)  # of the same area
    i, j = np.triu_indices(n, 1)
    apart = np.abs(site.positions_m[i] - site.positions_m[j]) / side
    firsts, seconds, total = [], [], 0.0
    for axis in (0, 1):
        in_line = (apart[:, 1 - axis] < 0.5) & (apart[:, axis] > _APART[0]) & (apart[:, axis] < _APART[1])
        ratio = apart[in_line, axis] * side / disc_m
        along = 0.340 * (1 - 0.570 * ratio ** (-1 / 3) - 0.040 * ratio ** (-7 / 3))
        across = 0.340 * (1 - 0.855 * ratio ** (-1 / 3) + 0.030 * ratio ** (-7 / 3))
        for slopes_axis, coefficient in ((axis, along), (1 - axis, across)):
            firsts.append(i[in_line] + slopes_axis * n)
            seconds.append(j[in_line] + slopes_axis * n)
            total += float(coefficient.sum())
    return np.concatenate(firsts), np.concatenate(seconds), total * disc_m ** (-1 / 3)
