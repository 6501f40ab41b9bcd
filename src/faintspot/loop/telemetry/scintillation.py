"""Scintillation and fades, from the fluxes of sub-apertures.

Photon and read noise of one frame tell nothing of the next: the covariance of the flux with that of later
frames has no noise. Extrapolated to the frame itself, it is the variance of the light. Errors are those of a
jackknife over pieces of the recording: frames need not be independent.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.arrays import Floats
from faintspot.base.checks import increasing, number_between
from faintspot.base.errors import InputError
from faintspot.base.statistics import student
from faintspot.loop.control.identification.open_loop import Measured

FEWEST_FRAMES = 400
_PIECES = 20
_LIT = 0.1  # of the flux of the brightest tenth, from which a sub-aperture counts
_STUDENT = student(_PIECES - 1) / 1.96  # of so few pieces, over that of many
_TO_FRAME = (3.0, -3.0, 1.0)  # a parabola through the covariances at lags of one to three frames, at lag 0
_OF_LINE = 0.5  # of the difference to a straight line, as an error of the extrapolation
_OF_NOISE = 0.04  # relative error of a frequency, of the noise that is taken off
_FEWEST_FADES = 20
_MOST_MADE = 0.2  # of the frames below the level, by as much noise again
_MOST_NOISE = 0.08  # of the change of the light from frame to frame


@dataclass(frozen=True, eq=False)
class Scintillation:
    """Scintillation of a recording's light."""

    index: Floats
    """(n,): variance of each sub-aperture's light over its mean squared; NaN with little flux."""
    index_error: Floats
    values: list[Measured]
    """Values for the sub-apertures' mean, the aperture, and its fades."""


def measure_scintillation(
    flux: ArrayLike, frame_rate_hz: float, level: float = 0.5, frame: ArrayLike | None = None
) -> Scintillation:
    """Return scintillation indices without noise, how fast the light varies, and its fades.

    Light that is the same in no two frames in a row is taken for noise: the frames must be several times
    faster than the scintillation. Errors hold where the recording has hundreds of its fluctuations.

    Parameters
    ----------
    flux : (t, n) array
        Flux of each sub-aperture in each frame, any unit; NaN: not measured, the sub-aperture is left out.
    frame_rate_hz : float
    level : float
        Flux of the whole aperture below which it fades, relative to its mean.
    frame : (t,) array of int, optional
        Frame numbers; default: no frame is lost.

    Raises
    ------
    InputError
        For another shape, fewer than 400 frames, or a level that is not within 0 to 1.

    Examples
    --------
    >>> import numpy as np
    >>> rng = np.random.default_rng(1)
    >>> light = np.exp(0.3 * np.sin(np.arange(4000) / 7.0))[:, None] * np.ones(5)
    >>> found = measure_scintillation(rng.poisson(100 * light), 500.0)
    >>> [f"{value.name}: {value.value:.3g}" for value in found.values[:2]]
    ['index of a sub-aperture: 0.0446', 'index of the aperture: 0.0446']
    """
    values = np.asarray(flux, np.float64)
    rate = number_between("frame_rate_hz", frame_rate_hz, 0.0, math.inf, low_open=True)
    level = number_between("level", level, 0.0, 1.0, low_open=True)
    if values.ndim != 2 or len(values) < FEWEST_FRAMES:
        raise InputError(
            f"flux: expected shape (frames, n), {FEWEST_FRAMES} frames or more, got {values.shape}"
        )
    count = len(values)
    numbers = np.arange(count) if frame is None else increasing("frame", frame, count, integer=True)
    lit = np.isfinite(values).all(axis=0)
    mean_flux = np.where(lit, values.mean(axis=0), 0.0)
    lit &= mean_flux > _LIT * np.quantile(mean_flux, 0.9)
    if not lit.any():
        raise InputError("flux: expected a sub-aperture with flux in all frames, got none")
    seen = values[:, lit]
    light = np.column_stack([seen, seen.sum(axis=1)])
    pieces = _Pieces(light, numbers)
    of_each, error = _indices(pieces, lambda each: each)
    index, index_error = (np.full(values.shape[1], np.nan) for _ in range(2))
    index[lit], index_error[lit] = of_each[:-1], error[:-1]
    mean, its_error = _indices(pieces, lambda each: each[:-1].mean(keepdims=True))
    results = [
        _seen("index of a sub-aperture", float(mean[0]), float(its_error[0])),
        _seen("index of the aperture", float(of_each[-1]), float(error[-1])),
        _half_width(pieces, rate),
        *_fades(pieces, seen.mean(axis=0) / seen.mean(axis=0).sum(), rate, level),
    ]
    return Scintillation(index, index_error, results)


class _Pieces:
    """Sums over pieces of a recording.

    Parameters
    ----------
    light : (t, m) array
    frame : (t,) array
        Frame numbers.
    """

    def __init__(self, light: Floats, frame: NDArray[np.int64]) -> None:
        self.light = light / light.mean(axis=0) - 1
        self.bounds = np.linspace(0, len(light), _PIECES + 1).astype(int)
        lags = range(len(_TO_FRAME) + 1)
        self.means = self._summed(self.light, np.ones(len(light)))
        self.products = [
            self._summed(
                self.light[: len(light) - lag] * self.light[lag:],
                frame[lag:] - frame[: len(light) - lag] == lag,
            )
            for lag in lags
        ]
        self.whole = np.array([(np.diff(frame[a:b]) == 1).all() for a, b in self.pieces])

    @property
    def pieces(self) -> list[tuple[int, int]]:
        """First and last frame of each piece."""
        return list(zip(self.bounds[:-1].tolist(), self.bounds[1:].tolist(), strict=True))

    def _summed(self, values: Floats, known: NDArray[np.generic]) -> Floats:
        """Return the sums of each piece over known frames, (pieces, m + 1): last, their number."""
        counted = np.column_stack([np.where(known[:, None], values, 0.0), known])
        return np.array([counted[a:b].sum(axis=0) for a, b in self.pieces])

    def covariances(self, weights: Floats) -> Floats:
        """Return the relative covariances at the lags from 0 on, (4, m), of pieces of these weights."""

        def mean(sums: Floats) -> Floats:
            total = weights @ sums
            return np.asarray(total[:-1] / total[-1])

        middle = mean(self.means)
        products = np.array([mean(sums) for sums in self.products])
        return (products - middle**2) / (1 + middle) ** 2

    def index(self, weights: Floats) -> Floats:
        """Return the indices, (m,)."""
        found: Floats = np.asarray(_TO_FRAME) @ self.covariances(weights)[1:]
        return found


def _jackknife(estimate: Callable[[Floats], Floats]) -> tuple[Floats, Floats]:
    """Return what an estimate gives without its bias, and standard errors that make an interval of 95 %."""
    whole = estimate(np.ones(_PIECES))
    without = np.array([estimate(weights) for weights in 1.0 - np.eye(_PIECES)])
    is_log = (whole > 0) & (without > 0).all(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        of, each = (np.where(is_log, np.log(part), part) for part in (whole, without))
    parts = _PIECES * of - (_PIECES - 1) * each
    value, error = parts.mean(axis=0), _STUDENT * parts.std(axis=0, ddof=1) / math.sqrt(_PIECES)
    value = np.where(is_log, np.exp(value), value)
    return value, error * np.where(is_log, value, 1.0)


def _indices(pieces: _Pieces, of: Callable[[Floats], Floats]) -> tuple[Floats, Floats]:
    """Return indices with their errors, those of the extrapolation among them; `of` takes them together."""
    value, error = _jackknife(lambda weights: of(pieces.index(weights)))
    covariance = pieces.covariances(np.ones(_PIECES))
    line = of(2 * covariance[1] - covariance[2])
    return value, np.hypot(error, _OF_LINE * np.abs(of(pieces.index(np.ones(_PIECES))) - line))


def _seen(name: str, value: float, error: float) -> Measured:
    """Return an index, or the limit below which it is."""
    if value > 2 * error:
        return Measured(name, "", value, error)
    return Measured(name, "", remark=f"not seen: below {max(value, 0.0) + 1.645 * error:.2g} (95 %)")


def _half_width(pieces: _Pieces, rate_hz: float) -> Measured:
    """Return the frequency below which half of the light's variance lies, mean of the sub-apertures."""
    name, unit = "half of the variance lies below", "Hz"
    length = int(np.diff(pieces.bounds).min())
    taper = np.hanning(length)[:, None]
    light = [pieces.light[a : a + length, :-1] * taper for a, _ in pieces.pieces]
    spectra = np.array([np.square(np.abs(np.fft.rfft(piece, axis=0))).mean(axis=1) for piece in light])
    spectra /= length * np.square(taper).sum()
    sides = np.where(np.isin(np.arange(spectra.shape[1]), [0, length / 2]), 1.0, 2.0)
    edges = (np.arange(spectra.shape[1]) + 0.5) * rate_hz / length

    def half(weights: Floats) -> Floats:
        kept = weights * pieces.whole
        covariance = pieces.covariances(weights)[0] - pieces.index(weights)
        power = np.cumsum(sides * (kept @ spectra / kept.sum() - covariance[:-1].mean() / length))
        if not power[-1] > 0:
            return np.array([np.nan])
        above = int(np.argmax(power >= 0.5 * power[-1]))
        before = power[above - 1] if above else 0.0
        low = edges[above - 1] if above else 0.0
        share = (0.5 * power[-1] - before) / (power[above] - before)
        return np.array([low + share * (edges[above] - low)])

    if not pieces.whole.sum() > 2:
        return Measured(name, unit, remark="frames are lost too often")
    value, error = (float(part[0]) for part in _jackknife(half))
    if not value > 2 * error:
        return Measured(name, unit, remark="not found: the light varies too little")
    if value < rate_hz / length:
        return Measured(
            name, unit, remark=f"below {rate_hz / length:.2g} Hz: too slow for so short a recording"
        )
    return Measured(name, unit, value, math.hypot(error, _OF_NOISE * value))


def _fades(pieces: _Pieces, parts: Floats, rate_hz: float, level: float) -> list[Measured]:
    """Return share and mean length of the fades of the aperture's light, where noise makes and ends few.

    `parts` (m - 1,) of the light are the sub-apertures': their noise is independent, and better known.
    """
    names = f"share of frames below {level:g} of the mean", "mean length of a fade"
    every = np.ones(_PIECES)
    light = 1 + pieces.light[:, -1]
    covariance, index = pieces.covariances(every), pieces.index(every)
    noise = math.sqrt(max(float(np.square(parts) @ (covariance[0] - index)[:-1]), 0.0))
    step = math.sqrt(max(2 * float(index[-1] - covariance[1, -1]), 0.0))
    noisier = light + noise * np.random.default_rng(1).standard_normal(len(light))
    below = light < level
    begins = below & ~np.concatenate([[False], below[:-1]])
    counts = np.array([[b - a, below[a:b].sum(), begins[a:b].sum()] for a, b in pieces.pieces], float)

    def unknown(remark: str) -> list[Measured]:
        return [Measured(name, unit, remark=remark) for name, unit in zip(names, ("", "s"), strict=True)]

    if begins.sum() < _FEWEST_FADES:
        return unknown(f"{begins.sum()} fades: too few")

    def found(weights: Floats) -> Floats:
        frames, faded, fades = weights @ counts
        return np.array([faded / frames, faded / max(fades, 1.0) / rate_hz])

    value, error = _jackknife(found)
    made = float((noisier < level).mean() - below.mean())  # by as much noise again
    share, length = unknown("hidden by noise")
    if abs(made) < _MOST_MADE * value[0]:
        spread = math.hypot(error[0], 0.5 * made)
        share = Measured(names[0], "", float(value[0]) - made, spread, is_positive=True)
    if noise < _MOST_NOISE * step:
        length = Measured(names[1], "s", float(value[1]), float(error[1]), is_positive=True)
    return [share, length]
