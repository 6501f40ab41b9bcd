"""White noise of open-loop slopes, apart from the turbulence that the wind carries past them.

The power spectra of slopes are a sum of white noise and of frozen von Karman turbulence with winds of several
speeds and directions, along x and along y alike. Of each possible noise the likeliest turbulence is found
(Whittle), and the noise is averaged over what is likely. So its error grows where turbulence is so fast that
both look alike. Winds count in sub-apertures a frame: neither frame rate nor scale need be known.
"""

import itertools
import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import scipy

from faintspot.base.arrays import Floats
from faintspot.loop.control.identification.loop_delay import FEWEST_SUBAPERTURES, INDEPENDENT, bins_of
from faintspot.loop.control.identification.slope_spectra import SlopeSpectra
from faintspot.loop.slope_covariance import SlopeTurbulence

_LENGTHS, _EVERY = (128, 64, 32, 16), (1, 2, 3)  # frames of a piece, and steps between these
_FEWEST_PIECES, _COVERED = 6, 0.5  # least part of the measured slopes in whole pieces
_SPEEDS = 0.005, 0.01, 0.02, 0.04, 0.07, 0.11, 0.16, 0.22, 0.3, 0.4, 0.55, 0.8  # sub-apertures a frame
_ANGLES = np.linspace(0, np.pi / 2, 4)  # from x to y
_OUTER_SCALE = 40.0  # sub-apertures
_UPDATES, _POWER = 150, 0.9
_LEVELS, _HIGHEST, _LIKELY = 16, 1.4, 8.0  # noises tried, in that of the highest frequencies; log likelihood
_UNKNOWN, _LIMIT = 2.0, 1.0  # log likelihood of the lowest level, and relative error if there may be none
_NARROWER, _LOW = 0.8, 0.75  # of the spread; errors by which the likeliest turbulence takes noise for its own
_SMOOTHED = 5  # frequencies over which the scatter of powers is averaged
_ALIKE = 0.3  # standard deviation of the turbulence's strength among slopes
_OF_PARABOLA = 2.5  # variance of the product of Gaussian noise and its deviation from a parabola
_LEAST = 0.1  # of the mean noise of an axis; and of what a slope's own spectrum says


class SlopeNoise(NamedTuple):
    """Variance of the white noise of slopes."""

    variance: Floats
    """(m,)"""
    error: Floats
    """(m,): relative standard error of each, beside the one that all share; NaN where it is unknown."""
    shared_error: float
    """Relative standard error that all slopes share, as turbulence may be taken for noise."""


def noise_of_slopes(slopes: Floats) -> SlopeNoise:
    """Return the noise of open-loop slopes (frames, 2 n) without gaps in the grid of frames, NaN if unknown.

    From the slopes without each frame's mean along x and y, which fast vibrations change.
    """
    n = slopes.shape[1] // 2
    if n < FEWEST_SUBAPERTURES:
        return _noise(slopes)
    axes = slopes.reshape(-1, 2, n)
    measured = np.isfinite(axes)
    mean = np.nansum(axes, axis=2, keepdims=True) / np.maximum(measured.sum(axis=2, keepdims=True), 1)
    noise = _noise((axes - mean).reshape(slopes.shape))
    variance = noise.variance.reshape(2, n)
    # The mean takes some of each slope's noise away, and adds some of the others'.
    total = variance.sum(axis=1, keepdims=True) * n / (n - 1)
    return noise._replace(variance=((variance - total / n**2) / (1 - 2 / n)).ravel())


def _noise(slopes: Floats) -> SlopeNoise:
    """Return the noise from spectra, or of too few frames from deviations, of an unknown shared error."""
    (power, length, every), m = _powers(slopes), slopes.shape[1]
    known = np.all(np.isfinite(power[:, 0]).reshape(len(power), 2, m // 2).any(axis=2), axis=1)
    if np.count_nonzero(known) < _FEWEST_PIECES or not np.nansum(power[known]) > 0.0:
        near, far = slopes[3:-1] + slopes[1:-3], slopes[4:] + slopes[:-4]
        products = slopes[2:-2] * (slopes[2:-2] - (4 * near - far) / 6)
        count = np.isfinite(products).sum(axis=0)
        error = np.where(count > 0, np.sqrt(_OF_PARABOLA / np.maximum(count, 1)), np.nan)
        return SlopeNoise(np.nansum(products, axis=0) / np.maximum(count, 1), error, math.nan)
    pieces = np.nanmean(power[known].reshape(np.count_nonzero(known), -1, 2, m // 2), axis=3)
    mean = pieces.mean(axis=0)
    mean = np.maximum(mean, 1e-12 * float(mean.max()))
    scatter = scipy.ndimage.uniform_filter1d(
        (pieces / mean).var(axis=0, ddof=1), _SMOOTHED, axis=0, mode="nearest"
    )
    weight = INDEPENDENT * len(pieces) / np.maximum(scatter, 2 / m)
    of_axes, shared = [], []
    for axis, of_slopes in enumerate(np.split(power, 2, axis=2)):
        level, of_all, model = _likely(mean, weight, _turbulence(length, every), axis)
        shared.append(of_all)
        of_axes.append(_of_each(of_slopes, level, model))
    variance, error = np.hstack(of_axes)
    return SlopeNoise(variance, error, float(np.mean(shared)))


def _powers(slopes: Floats) -> tuple[Floats, int, int]:
    """Return powers (pieces, frequencies, m) of half-overlapping pieces, their frames, and the step of these.

    NaN where a frame is missing: the longest pieces of the smallest step of which enough have no gap, else
    those of which most have none.
    """
    most, best = -1.0, (np.zeros((0, 1, slopes.shape[1])), 0, 0)
    measured = max(float(np.isfinite(slopes).mean()), 1e-9)
    for every, length in itertools.product(_EVERY, _LENGTHS):
        reach = (length - 1) * every + 1
        # Pieces begin at each frame of a step.
        starts = range(0, len(slopes) - reach + 1, length * every // 2 + every - 1)
        if len(starts) < _FEWEST_PIECES:
            continue
        window = _window(length)[:, None]
        parts = (slopes[start : start + reach : every] * window for start in starts)
        powers = [np.square(np.abs(np.fft.rfft(part, axis=0)[bins_of(length)])) for part in parts]
        whole = float(np.isfinite([power[0] for power in powers]).mean()) / measured
        if whole > most:
            most, best = whole, (np.array(powers), length, every)
        if most > _COVERED:
            break
    return best


def _window(length: int) -> Floats:
    window = np.hanning(length + 2)[1:-1]
    return np.asarray(window / np.linalg.norm(window))


@lru_cache(maxsize=8)
def _turbulence(length: int, every: int) -> Floats:
    """Return spectra of turbulence (winds, frequencies, 2) of slopes along x and along y."""
    still = np.ones(1), np.zeros((1, 2))
    site = SlopeTurbulence(np.zeros((1, 2)), 1.0, 1.0, 1.0, _OUTER_SCALE, *still)
    reach = max(_SPEEDS) * every * length
    spectra = SlopeSpectra(site, float(every), _window(length), bins_of(length), reach)
    tables, _ = spectra.tables(_OUTER_SCALE)
    winds = [speed * np.array([np.cos(angle), np.sin(angle)]) for speed in _SPEEDS for angle in _ANGLES]
    parts = np.array([spectra.of_wind(wind, tables).real[:, [0, 2]] for wind in winds])
    return np.asarray(np.maximum(parts / parts.mean(axis=(1, 2), keepdims=True), 1e-12))


def _likely(power: Floats, weight: Floats, turbulence: Floats, axis: int) -> tuple[float, float, Floats]:
    """Return the variance of an axis' noise, its relative error, and its likeliest spectrum (frequencies,).

    Parameters
    ----------
    power : (frequencies, 2) array
        Mean spectra along x and y.
    weight : (frequencies, 2) array
        Independent measurements of each.
    turbulence : (winds, frequencies, 2) array
    axis : int
    """
    own = np.zeros(power.shape)
    own[:, axis] = 1.0
    parts = np.concatenate([turbulence, 1 - own[None]]).reshape(len(turbulence) + 1, -1)
    flat, weight = power.ravel(), weight.ravel()
    start = np.append(np.repeat(_SPEEDS, len(_ANGLES)) ** -2, 1.0)  # of fast turbulence what the spectra show
    top = _HIGHEST * math.sqrt(float(power[-max(2, len(power) // 8) :, axis].mean()))
    deviation = np.linspace(0.0, top, _LEVELS + 1)[1:]
    for _ in range(2):  # once more among those that are likely
        noise = np.square(deviation)[:, None] * own.ravel()
        strength = np.tile(float(flat.mean()) * start / start.sum(), (_LEVELS, 1))
        for _ in range(_UPDATES):
            ratio = flat / (noise + strength @ parts)
            explained = (weight * ratio**2 / flat) @ parts.T
            strength *= np.maximum(explained / ((weight * ratio / flat) @ parts.T), 1e-9) ** _POWER
        ratio = flat / (noise + strength @ parts)
        unlikely = (weight * (ratio - np.log(ratio))).sum(axis=1)
        best = int(unlikely.argmin())
        counts = np.square(noise[best] * ratio[best] / flat)  # where there is noise
        misfit = max(1.0, float(np.average(weight * np.square(ratio[best] - 1), weights=counts)))
        unlikely = (unlikely - unlikely[best]) / misfit
        likelihood = np.exp(-unlikely) / np.exp(-unlikely).sum()
        mean = float(likelihood @ deviation)
        spread = math.sqrt(float(likelihood @ np.square(deviation - mean)))
        spread *= _NARROWER
        if unlikely[0] < _UNKNOWN:  # there may be no noise at all
            spread = max(spread, _LIMIT * mean)
        near = np.flatnonzero(unlikely < _LIKELY)
        low, high = deviation[[max(near[0] - 1, 0), min(near[-1] + 1, _LEVELS - 1)]]
        deviation = np.linspace(low, high, _LEVELS)
    level = mean + _LOW * spread
    return level**2, 2 * spread / level, power[:, axis] / ratio[best].reshape(power.shape)[:, axis]


def _of_each(power: Floats, noise: float, model: Floats) -> Floats:
    """Return the noise of each slope of an axis and its relative error, (2, k); NaN where it is unknown.

    Parameters
    ----------
    power : (pieces, frequencies, k) array
    noise : float
        Mean variance.
    model : (frequencies,) array
        Mean spectrum: noise, and turbulence that is of slightly different strength in each slope.
    """
    count = INDEPENDENT * np.isfinite(power[:, 0]).sum(axis=0)
    used = count > 0
    measured, parts = np.nanmean(power[:, :, used], axis=0), np.array([noise / model, 1 - noise / model])
    inverse = np.linalg.inv(parts @ parts.T + np.diag([1e-9, 1 / (_ALIKE**2 * float(count.mean()))]))
    deviation = (inverse @ parts)[0] @ (measured / measured.mean(axis=1, keepdims=True) - 1)
    error = np.sqrt(inverse[0, 0] / count[used])
    # As different as the slopes are more than by chance.
    differ = max(float(deviation.var() - np.square(error).mean()), 0.0)
    kept = np.maximum(differ / (differ + np.square(error)), _LEAST)
    result = np.array([np.zeros(len(count)), np.full(len(count), np.nan)])
    result[:, used] = noise * (1 + np.maximum(kept * deviation, _LEAST - 1)), np.sqrt(kept) * error
    return result
