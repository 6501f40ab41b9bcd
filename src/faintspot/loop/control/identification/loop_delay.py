"""Delay and centroid gain of a closed loop from its slopes and commands.

With the right delay and gain, slopes without the mirror's part are turbulence and white noise. With wrong
ones the noise that the loop has sent to the mirror is left in them and modulates their spectrum. So the mean
spectrum is compared with that of von Karman turbulence, carried by winds of several speeds, and white noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.loop.control.identification.slope_spectra import SlopeSpectra
from faintspot.loop.turbulence.slope_covariance import SlopeTurbulence

Floats = NDArray[np.float64]

_WINDOW = 128  # frames
_FEWEST_PIECES = 8
_MOST_DELAY = 5
_DELAYS = np.arange(1.0, _MOST_DELAY + 0.01, 0.1)
_GAINS, _FINE_GAINS = np.arange(0.25, 1.51, 0.05), np.arange(0.25, 1.51, 0.0125)
_EXPECTED_GAIN, _LOWER_SPREAD, _HIGHER_SPREAD = 0.9, 0.3, 0.15
"""Gain before telemetry: wide spots, noise and speckles reduce it, little raises it."""
_MODEL_ERROR = 0.05  # frames: spectra of real slopes differ from the theory
_SPEEDS_M_PER_S = (1.0, 3.0, 6.0, 10.0, 15.0, 22.0, 32.0)
_DIRECTIONS = 4  # of half a turn: opposite winds have the same spectrum
_MOST_SUBAPERTURES = 40
_UPDATES = 200
FEWEST_SUBAPERTURES = 3
"""Fewer show only tip and tilt, in which vibrations cannot be told from turbulence."""


@dataclass(frozen=True)
class LoopDelay:
    """Delay and centroid gain with standard errors."""

    delay_frames: float
    """The command computed from frame k acts first during frame k + delay; fractions: within it."""
    delay_error: float
    gain: float
    """Centroid gain relative to the interaction matrix."""
    gain_error: float


def loop_delay(
    slopes_px: Floats,
    sent_px: Floats,
    run: NDArray[np.int64],
    site: SlopeTurbulence,
    rate_hz: float,
    delay_frames: float | None = None,
) -> LoopDelay:
    """Return delay and centroid gain of a closed loop.

    Parameters
    ----------
    slopes_px : (frames, 2 n) array
        Residual slopes.
    sent_px : (frames, 2 n) array
        Slopes of the command computed from each frame, by the interaction matrix.
    run : (frames,) array of int
        Frames with the same number are consecutive.
    site : SlopeTurbulence
        Geometry and outer scale.
    rate_hz : float
    delay_frames : float, optional
        Where it is known: then only the gain is estimated.

    Raises
    ------
    InputError
        When there are fewer than 3 sub-apertures, because vibrations change tip and tilt, or fewer than 8
        pieces of 128 consecutive frames, half overlapping.
    """
    n = len(site.positions_m)
    if n < FEWEST_SUBAPERTURES:
        raise InputError(
            f"recording: expected {FEWEST_SUBAPERTURES} sub-apertures or more, as vibrations hide it in tip "
            f"and tilt, got {n}"
        )
    kept = np.arange(n)[:: math.ceil(n / _MOST_SUBAPERTURES)]
    columns = np.concatenate([kept, kept + n])
    site = replace(site, positions_m=site.positions_m[kept])
    window = np.hanning(_WINDOW + 2)[1:-1]
    window /= np.linalg.norm(window)
    slopes, sent = (_without_tilt(values[:, columns]) for values in (slopes_px, sent_px))
    products = _products(slopes, sent, run, window)
    delays, gains = (_DELAYS, _GAINS) if delay_frames is None else (np.array([delay_frames]), _FINE_GAINS)
    spectra = np.array([_spectra(products, delay, gains) for delay in delays]).reshape(-1, len(products))
    misfit = _misfit(spectra[:, 1:-1], _turbulence(site, rate_hz, window)[:, 1:-1])
    misfit = misfit.reshape(len(delays), len(gains))
    # As many independent values as the best fit is good, so that a model that does not fit has wide errors;
    # half of them, as neighbouring frequencies are alike under the window.
    spread = np.where(gains < _EXPECTED_GAIN, _LOWER_SPREAD, _HIGHER_SPREAD)
    likelihood = -0.25 * (_WINDOW // 2 - 1) * misfit / misfit.min()
    likelihood -= 0.5 * ((gains - _EXPECTED_GAIN) / spread) ** 2
    weight = np.exp(likelihood - likelihood.max())
    delay, delay_error = _moments(delays, weight.sum(axis=1))
    gain, gain_error = _moments(gains, weight.sum(axis=0))
    if delay_frames is None:
        delay_error = math.hypot(delay_error, _MODEL_ERROR)
    return LoopDelay(delay, delay_error, gain, gain_error)


def _moments(values: Floats, weight: Floats) -> tuple[float, float]:
    """Return mean and standard deviation, the latter not below that of the grid's step."""
    mean = float(weight @ values / weight.sum())
    step = float(values[1] - values[0]) if len(values) > 1 else 0.0
    return mean, math.sqrt(float(weight @ (values - mean) ** 2 / weight.sum()) + step**2 / 12)


def _without_tilt(slopes: Floats) -> Floats:
    """Return slopes without each frame's mean along x and y, where vibrations are, and without their mean."""
    axes = (slopes - slopes.mean(axis=0)).reshape(len(slopes), 2, -1)
    axes = axes - axes.mean(axis=2, keepdims=True)
    return np.asarray(axes.reshape(slopes.shape))


def _products(slopes: Floats, commands_px: Floats, run: NDArray[np.int64], window: Floats) -> Floats:
    """Return mean products (frequencies, 1 + lags, 1 + lags) of transforms of slopes and earlier commands."""
    lags = _MOST_DELAY + 1
    length, total, pieces = len(window), 0.0, 0
    for start in range(lags, len(slopes) - length + 1, length // 2):
        if run[start - lags] != run[start + length - 1]:
            continue
        parts = [slopes[start : start + length]]
        parts += [commands_px[start - lag : start - lag + length] for lag in range(1, lags + 1)]
        transformed = np.fft.rfft(np.array(parts) * window[:, None], axis=1)
        total = total + np.einsum("lfm,kfm->flk", transformed, transformed.conj()).real / slopes.shape[1]
        pieces += 1
    if pieces < _FEWEST_PIECES:
        raise InputError(
            f"recording: expected {length * (_FEWEST_PIECES + 1) // 2} consecutive frames, got {len(slopes)}"
        )
    return np.asarray(total / pieces)


def _spectra(products: Floats, delay: float, gains: Floats) -> Floats:
    """Return mean spectra (gains, frequencies) of open-loop slopes."""
    whole_frames = min(int(delay), _MOST_DELAY)
    weight = np.zeros((len(gains), products.shape[1]))
    weight[:, 0] = 1.0
    weight[:, whole_frames] -= gains * (1 - (delay - whole_frames))
    weight[:, whole_frames + 1] -= gains * (delay - whole_frames)
    return np.asarray(np.einsum("gl,flk,gk->gf", weight, products, weight, optimize=True))


def _turbulence(site: SlopeTurbulence, rate_hz: float, window: Floats) -> Floats:
    """Return mean spectra (speeds + 1, frequencies) without tilt, of turbulence and, last, of white noise."""
    length, n = len(window), len(site.positions_m)
    bins = np.arange(length // 2 + 1)
    spectra = SlopeSpectra(site, 1 / rate_hz, window, bins, max(_SPEEDS_M_PER_S) * length / rate_hz)
    tables, _ = spectra.tables(site.outer_scale_m)
    within = np.eye(n) - 1 / n
    angles = np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
    levels = [np.ones(len(bins))]
    for speed in _SPEEDS_M_PER_S:
        winds = speed * np.column_stack([np.cos(angles), np.sin(angles)])
        full = spectra.matrices(np.mean([spectra.of_wind(wind, tables) for wind in winds], axis=0)).real
        axes = full[:, :n, :n] + full[:, n:, n:]
        levels.insert(-1, np.einsum("fij,ji->f", axes, within))
    return np.array(levels)


def _misfit(spectra: Floats, parts: Floats) -> Floats:
    """Return half the deviance of spectra (k, frequencies) from non-negative sums of components, (k,)."""
    strength = 0.1 * spectra.mean(axis=1)[:, None] / parts.mean(axis=1)
    for _ in range(_UPDATES):
        model = strength @ parts
        strength *= (((spectra / model**2) @ parts.T) / ((1 / model) @ parts.T)) ** 0.9
    ratio = spectra / (strength @ parts)
    return np.asarray((ratio - 1 - np.log(ratio)).sum(axis=1))
