"""Narrow-band vibrations of tip, tilt and focus in open-loop slopes."""

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from faintspot.base.arrays import Floats
from faintspot.loop.control.kalman.predictor import SlopeModel

MODES = ("tip", "tilt", "focus")
_SEGMENT_S = 2.0
_FEWEST_SEGMENTS = 5
_LOWEST_HZ = 4.0  # below, turbulence is steep, and predicted well without
_FALSE_ALARM = 0.01  # of a whole spectrum
_BACKGROUND_BINS = 41
_LINE_BINS = 12  # on each side of a peak, to which a line is fitted
_SMOOTH_ORDER = 3  # of the polynomial that is the logarithm of the spectrum without the line
_MOST_TRIED, _MOST_PER_MODE = 6, 2
_DAMPING = 1e-6, 0.1
_MOST_DAMPING = 0.05  # that of telescopes' structures is 0.005 to 0.03
_LEAST_DAMPING = 1e-3  # of a model: the phase of no vibration is certain for ever
_START_DAMPING = 3e-3
_GRID_DAMPING, _GRID_OFF = 0.08, 0.3
"""Line of a layer that passes over the grid of sub-apertures: half the damping of a line fitted to its
maximum, in sides of a sub-aperture in the sensor; largest distance from its frequency, in widths of the
maximum."""


@dataclass(frozen=True)
class Vibration:
    """Damped oscillator driven by white noise."""

    mode: str
    """One of `MODES`."""
    frequency_hz: float
    damping: float
    """Damping ratio."""
    rms_px: float
    """Rms of the slopes, over all sub-apertures."""
    frequency_error_hz: float
    rms_error_px: float

    def recursion(self, rate_hz: float) -> tuple[float, float]:
        """Return a, b of y[k + 1] = a y[k] + b y[k - 1] + noise."""
        radius = math.exp(-2 * math.pi * self.damping * self.frequency_hz / rate_hz)
        angle = 2 * math.pi * self.frequency_hz * math.sqrt(1 - self.damping**2) / rate_hz
        return 2 * radius * math.cos(angle), -(radius**2)

    def driving_variance(self, rate_hz: float) -> float:
        """Return the driving variance of the recursion for an oscillation of variance 1."""
        first, second = self.recursion(rate_hz)
        return (1 + second) * ((1 - second) ** 2 - first**2) / (1 - second)

    def correlation(self, rate_hz: float, frames: int) -> Floats:
        """Return the autocorrelation at lags of 0, 1, ... frames."""
        first, second = self.recursion(rate_hz)
        radius, lags = math.sqrt(-second), np.arange(frames)
        cosine = first / (2 * radius)
        angle, sine = math.acos(cosine), math.sqrt(1 - cosine**2)
        later = (first / (radius * (1 - second)) - cosine) / sine
        return np.asarray(radius**lags * (np.cos(angle * lags) + later * np.sin(angle * lags)))


def mode_shapes(positions_m: Floats) -> Floats:
    """Return the slopes of `MODES`, (3, 2 n), each with a sum of squares of 1."""
    n = len(positions_m)
    centred = positions_m - positions_m.mean(axis=0)
    ones, zeros = np.ones(n), np.zeros(n)
    shapes = np.array([np.r_[ones, zeros], np.r_[zeros, ones], centred.T.ravel()])
    return np.asarray(shapes / np.maximum(np.linalg.norm(shapes, axis=1), 1e-12)[:, None])


def find_vibrations(amplitudes: Floats, rate_hz: float, slopes: int) -> tuple[Vibration, ...]:
    """Return the significant narrow lines in the spectra of `MODES`.

    Parameters
    ----------
    amplitudes : (frames, 3) array
        Open-loop slopes times `mode_shapes`.
    rate_hz : float
    slopes : int
        Number of slopes that the modes were taken from.
    """
    if _segment_length(len(amplitudes), rate_hz) < 2 * _BACKGROUND_BINS:
        return ()
    spectra, vibrations = mode_spectra(amplitudes, rate_hz), []
    for mode, spectrum in zip(MODES, spectra.power, strict=True):
        lines = _Lines(spectrum, spectra, rate_hz, slopes)
        vibrations += list(itertools.islice(lines.significant(mode), _MOST_PER_MODE))
    return tuple(vibrations)


@dataclass(frozen=True, eq=False)
class ModeSpectra:
    """Mean power spectra of modes in half-overlapping windowed segments."""

    power: Floats
    """(modes, frequencies): white noise has its variance."""
    window: Floats
    """(length,): window of a segment; the sum of squares is 1."""
    segments: int

    @property
    def length(self) -> int:
        """Frames of a segment."""
        return len(self.window)


def mode_spectra(amplitudes: Floats, rate_hz: float) -> ModeSpectra:
    """Return the spectra of amplitudes, (frames, modes)."""
    length = _segment_length(len(amplitudes), rate_hz)
    window = np.hanning(length + 2)[1:-1]
    window /= np.linalg.norm(window)
    starts = range(0, len(amplitudes) - length + 1, length // 2)
    segments = np.array([amplitudes[start : start + length] for start in starts])
    segments -= segments.mean(axis=1, keepdims=True)
    power = np.square(np.abs(np.fft.rfft(segments * window[:, None], axis=1))).mean(axis=0).T
    return ModeSpectra(power, window, len(segments))


def _segment_length(frames: int, rate_hz: float) -> int:
    return 2 * int(min(_SEGMENT_S * rate_hz, 2 * frames / (_FEWEST_SEGMENTS + 1)) / 2)


def with_vibrations(
    model: SlopeModel, vibrations: Sequence[Vibration], positions_m: Floats, rate_hz: float
) -> SlopeModel:
    """Return a model of slopes with vibrations on top.

    They are layers of their own, each with at most one vibration of each mode: these are orthogonal.
    """
    shapes = mode_shapes(positions_m)
    layers = [list(matrices) for matrices in (model.first, model.second, model.driving)]
    remaining = list(vibrations)
    while remaining:
        group = {vibration.mode: vibration for vibration in reversed(remaining)}
        remaining = [vibration for vibration in remaining if vibration is not group[vibration.mode]]
        added = np.zeros((3, model.slopes, model.slopes))
        for vibration in group.values():
            vibration = replace(vibration, damping=max(vibration.damping, _LEAST_DAMPING))
            shape = shapes[MODES.index(vibration.mode)]
            driving = model.slopes * vibration.rms_px**2 * vibration.driving_variance(rate_hz)
            numbers = np.array([*vibration.recursion(rate_hz), driving])
            added += numbers[:, None, None] * np.outer(shape, shape)
        for matrices, new in zip(layers, added, strict=True):
            matrices.append(new)
    return SlopeModel(*(np.array(matrices) for matrices in layers))


def without_passing_grid(
    vibrations: Sequence[Vibration], winds_m_per_s: Floats, positions_m: Floats, side_m: float, rate_hz: float
) -> tuple[Vibration, ...]:
    """Return the vibrations without those that are layers passing over the grid of sub-apertures.

    Waves as long as a sub-aperture (d) move all spots alike, as tip does, unless slopes are exact mean
    gradients. With a wind v along x they make a maximum at v / d; crossing the sensor takes D / v, so it is
    v / D wide. Lines that are much narrower are kept.

    Parameters
    ----------
    vibrations : sequence of Vibration
    winds_m_per_s : (layers, 2) array
    positions_m : (n, 2) array
        Centres of the sub-apertures.
    side_m : float
        Side of a sub-aperture.
    rate_hz : float
    """
    across_m = np.ptp(positions_m, axis=0) + side_m
    passing_hz, width_hz = np.abs(winds_m_per_s) / side_m, np.abs(winds_m_per_s) / across_m
    passing_hz = np.abs((passing_hz + 0.5 * rate_hz) % rate_hz - 0.5 * rate_hz)
    axes_of = dict(zip(MODES, ([0], [1], [0, 1]), strict=True))

    def is_grid(vibration: Vibration) -> bool:
        axes = axes_of[vibration.mode]
        near = np.abs(passing_hz[:, axes] - vibration.frequency_hz) < _GRID_OFF * width_hz[:, axes]
        return bool((near & (vibration.damping > _GRID_DAMPING * side_m / across_m[axes])).any())

    return tuple(vibration for vibration in vibrations if not is_grid(vibration))


class _Lines:
    """Spectrum of a mode that is searched for lines."""

    def __init__(self, spectrum: Floats, spectra: ModeSpectra, rate_hz: float, slopes: int) -> None:
        self._spectrum, self._rate_hz, self._slopes = spectrum, rate_hz, slopes
        self._segments, self._bin_hz, window = spectra.segments, rate_hz / spectra.length, spectra.window
        middle = float(scipy.special.gammaincinv(self._segments, 0.5)) / self._segments
        background = scipy.ndimage.median_filter(spectrum, _BACKGROUND_BINS, mode="nearest") / middle
        self._background = np.maximum(background, 1e-12 * spectrum.max() + 1e-300)
        self._correlation = np.correlate(window, window, "full")[len(window) - 1 :]

    def significant(self, mode: str) -> Iterator[Vibration]:
        """Yield the significant lines, that of the highest peak first."""
        yield from filter(None, (self._fitted(mode, peak) for peak in self._peaks()))

    def _peaks(self) -> Iterator[int]:
        """Yield the bins of peaks that stand out of the background, the highest first."""
        ratio = self._spectrum / self._background
        first = max(3, math.ceil(_LOWEST_HZ / self._bin_hz))
        ratio[:first] = ratio[-3:] = 0.0
        limit = float(scipy.special.gammainccinv(self._segments, _FALSE_ALARM / len(ratio))) / self._segments
        for _ in range(_MOST_TRIED):
            peak = int(np.argmax(ratio))
            if ratio[peak] <= limit:
                return
            yield peak
            ratio[max(0, peak - _LINE_BINS) : peak + _LINE_BINS + 1] = 0.0

    def _fitted(self, mode: str, peak: int) -> Vibration | None:
        """Fit frequency, damping and strength near a peak by Whittle's likelihood.

        None unless a smooth spectrum with the line is significantly more likely than one without.
        Turbulence has broad maxima, for example where the sub-apertures' grid passes over it.
        """
        bins = np.arange(max(1, peak - _LINE_BINS), min(len(self._spectrum), peak + _LINE_BINS + 1))
        power, lags = self._spectrum[bins], np.arange(len(self._correlation))
        transform = np.cos(2 * np.pi / len(lags) * np.outer(bins, lags)) * self._correlation
        transform[:, 1:] *= 2
        powers = ((bins - peak) / _LINE_BINS)[:, None] ** np.arange(_SMOOTH_ORDER + 1)

        def line(x: Floats) -> Vibration:
            damping = float(np.exp(np.clip(x[1], *np.log(_DAMPING))))
            frequency = (peak + float(np.clip(x[0], -2, 2))) * self._bin_hz
            rms = math.exp(0.5 * float(np.clip(x[2], -80, 80))) / math.sqrt(self._slopes)
            return Vibration(mode, frequency, damping, rms, math.nan, math.nan)

        def misfit(smooth: Floats, of_line: Floats | float = 0.0) -> float:
            logarithm = np.clip(powers[:, : len(smooth)] @ smooth, -60, 60)
            expected = self._background[peak] * np.exp(logarithm) + of_line
            return self._segments * float(np.sum(np.log(expected) + power / expected)) / 2

        def misfit_with(x: Floats) -> float:
            vibration = line(x)
            shape = transform @ vibration.correlation(self._rate_hz, len(lags))
            return misfit(x[3:], vibration.rms_px**2 * self._slopes * np.maximum(shape, 0.0))

        without = scipy.optimize.minimize(misfit, np.zeros(_SMOOTH_ORDER + 1)).fun
        strength = 4 * max(power.sum() - len(power) * self._background[peak], 1e-30) / len(lags)
        best = np.array([0.0, math.log(_START_DAMPING), math.log(strength)])
        for order in (1, _SMOOTH_ORDER):
            start, options = np.append(best, np.zeros(order)), {"maxiter": 2000, "xatol": 1e-3, "fatol": 1e-3}
            fit = scipy.optimize.minimize(misfit_with, start, method="Nelder-Mead", options=options)
            best = fit.x
        if without - fit.fun < scipy.special.chdtri(3, _FALSE_ALARM / len(self._spectrum)) / 2:
            return None
        errors, vibration = _errors(misfit_with, best), line(best)
        frequency, rms = errors[0] * self._bin_hz, 0.5 * errors[2] * vibration.rms_px
        if vibration.damping > _MOST_DAMPING or not math.isfinite(frequency + rms):
            return None
        return replace(vibration, frequency_error_hz=float(frequency), rms_error_px=float(rms))


def _errors(misfit: Callable[[Floats], float], best: Floats, step: float = 0.05) -> Floats:
    """Return standard errors from the curvature of half the deviance; infinite where there is none."""
    size = len(best)
    curvature = np.zeros((size, size))
    offsets = step * np.eye(size)
    for i in range(size):
        for j in range(i + 1):
            corners = [
                sign * misfit(best + first * offsets[i] + second * offsets[j])
                for first, second, sign in ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))
            ]
            curvature[i, j] = curvature[j, i] = sum(corners) / (4 * step**2)
    variance = np.diag(np.linalg.pinv(curvature))
    return np.sqrt(np.where(variance > 0, variance, np.inf))
