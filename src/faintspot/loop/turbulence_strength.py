"""Strength and outer scale of the turbulence from open-loop slopes or image motion, with their errors.

The variance of the slopes is split by the degree of polynomials over the pupil. Low degrees depend on the
outer scale, high ones on the centroid gain and on the averaging within a sub-aperture. The estimate weighs
each degree by its errors. Tip and tilt, which vibrations change, are left out.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.loop.slope_covariance import OUTER_SCALE_M, SlopeTurbulence
from faintspot.slopes.spots.shapes import R0_WAVELENGTH_M

OUTER_SCALE_SPREAD = 0.7
"""Standard deviation of the logarithm of the outer scale before telemetry."""

_SCALES_M = np.geomspace(4.0, 250.0, 13)
_FINE_SCALES_M = np.geomspace(4.0, 250.0, 61)
_MOST_SUBAPERTURES = 150
_LONGEST_LAG = 4000  # frames
_GAIN_STEP = 0.05
_COMMON_ERROR = 0.03  # of r0: centroids of speckled, partly illuminated spots are not quite mean gradients
_ERROR_OF_DEGREE = 0.01  # of r0, for each degree: averaging within a sub-aperture
_TO_R0 = 3 / 5
_SEEN = 4.0  # standard deviations of the noise's, below which no variance is that of turbulence
_LAGS, _MOST_LOST = 20, 0.8  # of `sampled`: nodes of its integrals, and a limit


@dataclass(frozen=True)
class TurbulenceStrength:
    """Fried parameter and outer scale with standard errors."""

    r0_m: float
    """At 500 nm; NaN if the slopes vary no more than their noise."""
    r0_error_m: float
    outer_scale_m: float
    outer_scale_error_m: float


def turbulence_strength(
    atmosphere_px: Floats,
    residual_px: Floats,
    run: NDArray[np.int64],
    site: SlopeTurbulence,
    *,
    gain_error: float = 0.0,
    gain_spread: float = 0.0,
    outer_scale_m: float | None = None,
    frame_rate_hz: float | None = None,
) -> TurbulenceStrength:
    """Return r0 and the outer scale.

    Parameters
    ----------
    atmosphere_px, residual_px : (frames, 2 n) array
        Open-loop slopes, and residual slopes divided by the centroid gain. White noise is removed by
        extrapolating covariances of one and two frames to zero.
    run : (frames,) array of int
        Frames with the same number are consecutive.
    site : SlopeTurbulence
        Geometry, and winds if `frame_rate_hz` is given; its strength is not used.
    gain_error : float
        Relative standard error of the centroid gain.
    gain_spread : float
        Relative standard deviation between centroid gains of different spatial scales.
    outer_scale_m : float, optional
        Outer scale, where it is known; else 25 m within a factor of two are expected.
    frame_rate_hz : float, optional
        Frames per second, where the winds are known: they tell how much of the turbulence has crossed the
        pupil, see `sampled`. Default: from the autocorrelation of the slopes, too short for slow turbulence.
    """
    n = len(site.positions_m)
    kept = np.arange(n)[:: math.ceil(n / _MOST_SUBAPERTURES)]
    columns = np.concatenate([kept, kept + n])
    site = replace(site, positions_m=site.positions_m[kept], r0_m=1.0)
    atmosphere, residual = (
        slopes[:, columns] - slopes[:, columns].mean(axis=0) for slopes in (atmosphere_px, residual_px)
    )
    geometry = site.subaperture_m, site.pixel_scale_rad, site.averaged
    degrees, expected = _theory(tuple(map(tuple, site.positions_m.tolist())), *geometry)
    measured = [(basis, _signal(atmosphere @ basis, run)) for basis in degrees]
    usable = [(number, basis, signal) for number, (basis, signal) in enumerate(measured, 1) if signal > 0]
    if not usable:
        return TurbulenceStrength(math.nan, math.nan, outer_scale_m or OUTER_SCALE_M, math.nan)
    number, modes, signal = zip(*usable, strict=True)
    change = [_of_gain(atmosphere @ basis, residual @ basis, run) for basis in modes]
    sampling = [_sampling(atmosphere @ basis, run, value) for basis, value in zip(modes, signal, strict=True)]
    of_signal, of_noise = np.array(sampling).T
    if of_noise.min() > 1 / _SEEN**2:
        return TurbulenceStrength(math.nan, math.nan, outer_scale_m or OUTER_SCALE_M, math.nan)
    covariance, lost = np.diag(of_signal), np.zeros(len(modes))
    if frame_rate_hz is not None:
        lost, covariance = sampled(modes, site, len(atmosphere) / frame_rate_hz)
    of_degree = _ERROR_OF_DEGREE / _TO_R0 * np.array(number)
    covariance += np.diag(of_noise + np.square(gain_spread * np.array(change)) + np.square(of_degree))
    covariance += gain_error**2 * np.outer(change, change)
    theory = expected[:, np.array(number) - 1]
    return _fitted(np.log(signal / (1 - lost)), theory, covariance, outer_scale_m)


def _fitted(signal: Floats, theory: Floats, covariance: Floats, known_m: float | None) -> TurbulenceStrength:
    """Return mean and standard deviation over outer scales of the strength that fits best.

    `signal` and `theory` (scales, degrees) are logarithms of variances, the latter for r0 = 1 m.
    """
    scales = _FINE_SCALES_M if known_m is None else np.array([known_m])
    expected = np.array([np.interp(np.log(scales), np.log(_SCALES_M), values) for values in theory.T]).T
    inverse = np.linalg.inv(covariance)
    weight = inverse.sum(axis=0) / inverse.sum()
    strength = (signal - expected) @ weight
    residual = signal - expected - strength[:, None]
    likelihood = -0.5 * np.einsum("si,ij,sj->s", residual, inverse, residual)
    likelihood -= 0.5 * (np.log(scales / OUTER_SCALE_M) / OUTER_SCALE_SPREAD) ** 2
    part = np.exp(likelihood - likelihood.max())
    part /= part.sum()
    mean, scale = float(part @ strength), float(part @ np.log(scales))
    error = _TO_R0 * math.sqrt(float(part @ (strength - mean) ** 2) + 1 / inverse.sum())
    r0, outer = math.exp(-_TO_R0 * mean), math.exp(scale)
    spread = math.sqrt(float(part @ (np.log(scales) - scale) ** 2))
    return TurbulenceStrength(r0, r0 * math.hypot(error, _COMMON_ERROR), outer, outer * spread)


def _degrees(site: SlopeTurbulence) -> list[Floats]:
    """Return orthonormal slopes (2 n, modes) for each degree, as far as degrees are well sampled.

    With one or two sub-apertures: all slopes.
    """
    n = len(site.positions_m)
    if n <= 2:
        return [np.eye(2 * n)]
    centred = site.positions_m - site.positions_m.mean(axis=0)
    x, y = (centred / np.abs(centred).max()).T
    across = round(float(np.ptp(centred, axis=0).max()) / site.subaperture_m) + 1
    degrees, basis = [], np.zeros((2 * n, 0))
    for degree in range((across + 1) // 2 + 1):
        terms = np.array([x**power * y ** (degree - power) for power in range(degree + 1)]).T
        new = np.kron(np.eye(2), terms)
        for _ in range(2):
            new = new - basis @ (basis.T @ new)
        vectors, size, _ = np.linalg.svd(new, full_matrices=False)
        degrees.append(vectors[:, size > 1e-6])
        basis = np.hstack([basis, degrees[-1]])
    return degrees[1:]


@lru_cache(maxsize=4)
def _theory(
    positions_m: tuple[tuple[float, float], ...],
    subaperture_m: float,
    pixel_scale_rad: float,
    averaged: float,
) -> tuple[list[Floats], Floats]:
    """Return the degrees and the logarithms of their variances for r0 = 1 m, (scales, degrees); cached."""
    winds = np.ones(1), np.zeros((1, 2))
    site = SlopeTurbulence(
        np.array(positions_m), subaperture_m, pixel_scale_rad, 1.0, OUTER_SCALE_M, *winds, averaged
    )
    degrees = [degree for degree in _degrees(site) if degree.shape[1]]
    covariances = [replace(site, outer_scale_m=scale_m).covariance_px2() for scale_m in _SCALES_M]
    variances = [
        [float(np.einsum("ik,ij,jk->", modes, covariance, modes)) for modes in degrees]
        for covariance in covariances
    ]
    return degrees, np.log(variances)


def _lagged(modes: Floats, run: NDArray[np.int64], lag: int) -> float:
    together = run[lag:] == run[: len(run) - lag]
    products = (modes[lag:] * modes[: len(run) - lag])[together]
    return float(products.sum(axis=1).mean()) if len(products) else math.nan


def _signal(modes: Floats, run: NDArray[np.int64]) -> float:
    """Return the variance without white noise."""
    return (4 * _lagged(modes, run, 1) - _lagged(modes, run, 2)) / 3


def _of_gain(atmosphere: Floats, residual: Floats, run: NDArray[np.int64]) -> float:
    """Return the relative change of the variance with that of the centroid gain."""
    low, high = (_signal(atmosphere + step * residual, run) for step in (-_GAIN_STEP, _GAIN_STEP))
    return math.log(max(low, 1e-3 * abs(high)) / high) / (2 * _GAIN_STEP) if high > 0 else 1.0


def _sampling(modes: Floats, run: NDArray[np.int64], signal: float) -> tuple[float, float]:
    """Return the relative variance of `_signal` of Gaussian modes: of their autocorrelation, and of noise."""
    frames, count = len(modes), modes.shape[1]
    transformed = np.fft.rfft(modes, 2 * frames, axis=0)
    products = np.fft.irfft((transformed * transformed.conj()).real, 2 * frames, axis=0)
    lags = np.arange(min(frames // 2, _LONGEST_LAG))
    correlation = products[lags].sum(axis=1) / (frames - lags) / signal
    noise = max(float(correlation[0]) - 1, 0.0)
    last = int(np.argmax(correlation < 0)) or len(correlation)
    of_signal = 2 * (1 + 2 * float(np.square(correlation[1:last]).sum()))
    of_noise = 4 * noise + 17 / 9 * noise**2
    return of_signal / (frames * count), of_noise / (frames * count)


def sampled(bases: Sequence[Floats], site: SlopeTurbulence, duration_s: float) -> tuple[Floats, Floats]:
    """Return how well the variances of slopes are known that a piece of frozen turbulence shows.

    Parameters
    ----------
    bases : sequence of (2 n, modes) array
        Each gives the sum of the variances of its modes.
    site : SlopeTurbulence
        Geometry and winds.
    duration_s : float

    Returns
    -------
    lost : (bases,) array
        Part of each variance that is in the mean of the piece, at most 0.8.
    covariance : (bases, bases) array
        Relative covariance of the variances about the mean, of Gaussian slopes.
    """
    modes = np.hstack(bases)
    starts = np.cumsum([0, *(basis.shape[1] for basis in bases[:-1])])
    variance = np.add.reduceat(np.einsum("ik,ij,jk->k", modes, site.covariance_px2(), modes), starts)
    nodes, weights = np.polynomial.legendre.leggauss(_LAGS)
    lost, covariance = np.zeros(len(bases)), np.zeros((len(bases), len(bases)))
    for part, weight in zip(0.5 * (1 + nodes), 0.5 * weights, strict=True):
        lag = part**2  # of the duration: short lags count most
        later = modes.T @ site.covariance_px2(lag * duration_s) @ modes
        weight *= 4 * part * (1 - lag)
        lost += weight * np.add.reduceat(np.diag(later), starts)
        squares = np.add.reduceat(np.square(later), starts, axis=0)
        covariance += 2 * weight * np.add.reduceat(squares, starts, axis=1)
    lost = np.clip(lost / variance, 0.0, _MOST_LOST)
    left = variance * (1 - lost)
    return lost, covariance / np.outer(left, left)


_APART = (1.5, 3.5)  # sub-apertures: nearer ones see the same tilt, in farther ones the outer scale shows
_SQUARES = 0.02  # of r0: a square is not quite a disc of its area


def differential_image_motion(
    atmosphere_px: Floats, noise_px2: Floats, site: SlopeTurbulence, frame_rate_hz: float
) -> tuple[float, float]:
    """Return r0 at 500 nm and its standard error, m; NaN if the slopes vary no more than their noise.

    Tip and tilt, vibrations included, cancel in differences. An infinite outer scale is assumed: one of 10 m
    makes r0 14 % too large with sub-apertures of 0.6 m, one of 25 m 4 %. The error follows from how much
    of the turbulence has crossed the pupil, see `faintspot.loop.turbulence_strength.sampled`.

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
