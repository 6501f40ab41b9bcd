"""Modes of an interaction matrix, their spectra and noise; delay, gain and law of any closed loop.

With the right delay and gain, the open-loop spectrum of every mode is white noise and turbulence, which falls
with frequency. With wrong ones it has bumps that no such sum has. So delay and gain are those for which the
spectra are closest to such sums in the sense of Itakura & Saito, the contrast of Whittle's likelihood: it
does not depend on scale, so all delays and gains are compared by the shapes of their spectra alone.
Vibrations count little, and their wings are a part of the sum.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.errors import InputError
from faintspot.loop.control.identification.loop_delay import (
    GAINS,
    INDEPENDENT,
    MOST_DELAY,
    LoopDelay,
    bins_of,
    cross_spectra,
)
from faintspot.loop.control.identification.recording import Recording
from faintspot.loop.control.identification.slope_noise import SlopeNoise
from faintspot.loop.control.identification.vibrations import Vibration
from faintspot.loop.control.reconstructor import check_controllable

_WINDOW, _LONG_WINDOW, _FOR_LONG = 128, 256, 3200  # frames, and consecutive ones for the long window
_MOST_MODES = 8
_KNEES, _POWER = (1e-3, 3e-3, 1e-2, 3e-2), 3.0
"""Turbulence is a sum of (1 + (f / knee)^2)^-power, the knees in parts of the frame rate; a sum falls less
steeply than each, as Zernike tilt does (power 11 / 6) and the mean gradient over a pupil (17 / 6)."""
_FINE_KNEE, _MOST_MISFIT = 0.2, 1.0
"""Knee of turbulence too fine for the mirror, of which bright sensors see a part; added where spectra do not
fit: misfit of each frequency. Not of a few modes such as tip and tilt, whose spectra fall less steeply."""
_STEP, _GAIN_STEPS, _UPDATES = 0.1, 36, 30
_MOST_CONTRAST = 6.0  # of a frequency with more power than the model: vibrations count no more than that
_UNSTABLE = 1e4  # by how much more unlikely a gain is with which the recorded loop would not be stable
_CONTRADICTS = 10.0  # by how much more unlikely a delay is one that the recording contradicts
_EXPECTED_GAIN = 0.4  # standard deviation of the gain's logarithm about 0, before anything is measured
_MOST_PEAKS, _DAMPING = 4, 0.01  # bins of lines of a mode with wings, and these
_FEW_MODES = 4  # with which lines of the loop look like vibrations
_LINE, _BACKGROUND = 4.0, 9  # height of a line in standard deviations, and bins of the median around it
_DELAY_ERROR, _GAIN_ERROR = 0.06, 0.15  # frames, and relative: spectra differ from such sums
_FREQUENCIES = 2**14
_EXACT = 0.05  # part of a command's steps that a law leaves unexplained
_LEAST_MOVED = 0.01  # of the mode that is moved most: others tell little of the law
_LEAST_KEPT = 0.7  # of its command, by an integrator
INTEGRATOR, FILTERED, OTHER = "an integrator", "an integrator with a filter", "another law"


class ModalFits:
    """Delay and gain of a loop by the shapes of its modes' spectra.

    Parameters
    ----------
    modes : (frames, m) array
        Residual modes.
    sent : (frames, m) array
        Modes of the command computed from each frame, by the interaction matrix.
    run : (frames,) array of int
        Frames with the same number are consecutive.

    Raises
    ------
    InputError
        When there are fewer than 4 pieces of 128 consecutive frames, half overlapping.
    """

    def __init__(self, modes: Floats, sent: Floats, run: NDArray[np.int64]) -> None:
        longest = int(np.bincount(run - run.min()).max())
        window = np.hanning((_LONG_WINDOW if longest >= _FOR_LONG else _WINDOW) + 2)[1:-1]
        window /= np.linalg.norm(window)
        used = np.unique(np.geomspace(1, modes.shape[1], _MOST_MODES).astype(int)) - 1
        pairs = [(values[:, used] - values[:, used].mean(axis=0)).T for values in (modes, sent)]
        products = []
        for mode, command in zip(*pairs, strict=True):
            spectra, pieces = cross_spectra(mode[:, None], command[:, None], run, window)
            products.append(spectra[..., 0, 0])
        self._products = np.array(products)
        """(modes, frequencies, 1 + lags, 1 + lags)"""
        self._independent = INDEPENDENT * pieces
        power = self._products[..., 0, 0]
        lines = power * _lines(power, self._independent)
        self._gains = np.geomspace(GAINS[0], GAINS[1], _GAIN_STEPS)[1:-1]
        self._loop_gain = _gain_of_law(modes, sent, run, 1)
        self._delays = np.arange(1.0, MOST_DELAY + 0.5 * _STEP, _STEP)
        fine = [] if len(lines) < _FEW_MODES else [(*_KNEES, _FINE_KNEE)]
        for knees in [_KNEES, *fine]:
            self._shapes = _shapes(window, lines, knees)
            self._strength: Floats | None = None
            self._all = np.array([self._misfit(delay) for delay in self._delays])
            """(delays, gains): minus the logarithm of the likelihood."""
            if self._all.min() < _MOST_MISFIT * lines.size:
                break

    def of(self, delay_frames: float) -> LoopDelay:
        """Return the gain for a delay that is known; that of the best one if it does not fit at all."""
        known, misfit = np.array([delay_frames]), self._misfit(delay_frames)[None]
        if misfit.min() > self._all.min() + _CONTRADICTS:
            return replace(self.best(), delay_frames=delay_frames, delay_error=0.0)
        return self._likely(known, misfit)

    def best(self) -> LoopDelay:
        """Return delay and gain, averaged over those that are likely."""
        return self._likely(self._delays, self._all)

    def _likely(self, delays: Floats, misfit: Floats) -> LoopDelay:
        weight = np.exp(misfit.min() - misfit)
        weight /= weight.sum()
        later = float(weight.sum(axis=1) @ (delays - delays[0]))
        delay, gain = float(delays[0]) + later, float(weight.sum(axis=0) @ self._gains)
        of_delay = math.sqrt(float(weight.sum(axis=1) @ np.square(delays - delay)))
        of_gain = math.sqrt(float(weight.sum(axis=0) @ np.square(self._gains - gain)))
        error = 0.0 if len(delays) == 1 else math.hypot(of_delay, _DELAY_ERROR)
        return LoopDelay(delay, error, gain, math.hypot(of_gain, _GAIN_ERROR * gain))

    def _misfit(self, delay: float) -> Floats:
        """Return minus the logarithm of the likelihood of a delay, for all gains."""
        lag, part = int(delay), delay % 1
        lags, shares = ([lag, lag + 1], np.array([1 - part, part])) if part else ([lag], np.ones(1))
        crossed = self._products[:, :, 0, lags] @ shares
        squared = np.einsum("mfij,i,j->mf", self._products[:, :, lags][..., lags], shares, shares)
        gains, plain = self._gains[:, None, None], self._products[:, :, 0, 0]
        power = np.maximum(plain - 2 * gains * crossed + gains**2 * squared, 1e-12 * plain.max())
        shapes, strength = self._shapes, self._strength
        if strength is None:
            strength = np.einsum("gmf,ms->gms", power, 1 / shapes.sum(axis=2)) / shapes.shape[1]
        for _ in range(_UPDATES):
            model = np.einsum("gms,msf->gmf", strength, shapes, optimize=True)
            weight = np.exp(-self._contrast(power / model) / _MOST_CONTRAST) / model
            explained, expected = (
                np.einsum("gmf,msf->gms", values, shapes, optimize=True)
                for values in (weight * power / model, weight)
            )
            strength = strength * np.maximum(explained / np.maximum(expected, 1e-300), 1e-9)
        self._strength = np.maximum(strength, 1e-9 * np.max(strength, axis=-1, keepdims=True))
        ratio = power / np.einsum("gms,msf->gmf", strength, shapes)
        above = _MOST_CONTRAST * (1 - np.exp(-self._contrast(ratio) / _MOST_CONTRAST))
        below = self._independent * np.where(ratio < 1, ratio - np.log(ratio) - 1, 0.0)
        misfit: Floats = (above + below).sum(axis=(1, 2))
        # A recorded integrator was stable.
        unstable = self._gains * self._loop_gain > 2 * math.sin(math.pi / (4 * delay - 2))
        return misfit + 0.5 * (np.log(self._gains) / _EXPECTED_GAIN) ** 2 + _UNSTABLE * unstable

    def _contrast(self, ratio: Floats) -> Floats:
        """Return the contrast of powers above the model, 0 below it."""
        contrast: Floats = self._independent * np.where(ratio > 1, ratio - np.log(ratio) - 1, 0.0)
        return contrast


def _shapes(window: Floats, lines: Floats, knees: Sequence[float]) -> Floats:
    """Return windowed spectra of noise, turbulence and lines of each mode, (modes, parts, frequencies).

    Parameters
    ----------
    window : (frames,) array
    lines : (modes, frequencies) array
        Power in the lines of each mode, 0 elsewhere; the wings of the highest ones are parts.
    knees : sequence of float
        Of the turbulence.
    """
    frames, frequency = len(window), np.fft.fftfreq(_FREQUENCIES)
    seen = np.correlate(window, window, "full")[frames - 1 :]
    seen[1:] *= 2
    bins = bins_of(frames)
    cosines = np.cos(2 * np.pi / frames * np.outer(bins, np.arange(frames)))
    moments = [np.fft.ifft((1 + (frequency / knee) ** 2) ** -_POWER).real[:frames] for knee in knees]
    common = [np.ones(len(bins)), *(cosines @ (seen * moment / moment[0]) for moment in moments)]
    parts = []
    for line in lines:
        peaks = [k for k in np.argsort(-line)[:_MOST_PEAKS] if line[k] > 0]
        wings = [Vibration("", bins[k] / frames, _DAMPING, 1.0, 0.0, 0.0) for k in peaks]
        of_wings = [cosines @ (seen * wing.correlation(1.0, frames)) for wing in wings]
        parts.append([*common, *of_wings, *([common[0]] * (_MOST_PEAKS - len(peaks)))])
    return np.maximum(np.array(parts), 1e-12)


def _lines(power: Floats, independent: float) -> NDArray[np.bool_]:
    """Return where spectra have lines of vibrations, (modes, frequencies): not in most modes."""
    background = scipy.ndimage.median_filter(power, (1, _BACKGROUND), mode="nearest")
    high = power > (1 + _LINE / math.sqrt(independent)) * background
    return np.asarray(high if len(power) < _FEW_MODES else high & (high.mean(axis=0) <= 0.5))


def law_of(modes: Floats, sent: Floats, run: NDArray[np.int64]) -> str:
    """Return the name of the law that made the commands, with an integrator's gain, by regression of modes.

    Parameters as for `ModalFits`.
    """
    gain = _gain_of_law(modes, sent, run, 1)
    if math.isfinite(gain):
        return f"{INTEGRATOR} of gain {gain:.2g}"
    return FILTERED if math.isfinite(_gain_of_law(modes, sent, run, 4)) else OTHER


def _gain_of_law(modes: Floats, sent: Floats, run: NDArray[np.int64], before: int) -> float:
    """Return the gain of the integrator that made the commands from so many frames; NaN: another law did."""
    moved = np.flatnonzero(sent.std(axis=0) > _LEAST_MOVED * sent.std(axis=0).max())
    rows = np.flatnonzero(run[before:] == run[:-before]) + before
    left = total = 0.0
    gains, kept = [], []
    for mode, command in zip(modes.T[moved], sent.T[moved], strict=True):
        past = [command[rows - k] for k in range(1, before + 1)]
        now = [mode[rows - k] for k in range(before)]
        terms, steps = np.array([*now, *past]).T, command[rows] - command[rows - 1]
        weights = np.linalg.lstsq(terms, command[rows], rcond=None)[0]
        left += float(np.square(command[rows] - terms @ weights).sum())
        total += float(np.square(steps - steps.mean()).sum())
        gains.append(-float(weights[:before].sum()))
        kept.append(float(weights[before:].sum()))
    is_law = left <= _EXACT**2 * total and min(kept) > _LEAST_KEPT
    return float(np.median(np.abs(gains))) if is_law else math.nan


LEAST_MEASURED = 0.5
"""Part of a frame's slopes without which no mode of it is known; slopes that are missing count as 0."""
_SHORTEST, _LONGEST = 64, 4096  # frames of a piece
_PIECES = 4
_PLATEAU = 0.35  # cycles a frame, above which a spectrum is noise
_OF_MEDIAN, _NOT_FLAT = (
    2.5,
    0.06,
)  # variance of the noise in units of its square / frames; error where not flat
_LEAST_NOISE = 1e-6  # of the variance of a mode


class Modes(NamedTuple):
    """Recording in modes of its interaction matrix."""

    recording: Recording
    """Recording of (frames, k) modes; NaN where a frame has too few slopes."""
    analysis: Floats
    """(k, m): matrix from slopes to modes, 0 for slopes never measured; its rows are orthonormal."""


def modes_of(loop: Recording) -> Modes:
    """Return a recording in as many modes as it has commands, from those that move slopes most to the least.

    Raises
    ------
    InputError
        When no frame has most slopes, or there are more commands than slopes.
    """
    measured = np.isfinite(loop.slopes)
    matrix = np.where(measured.any(axis=0)[:, None], loop.interaction_matrix, 0.0)
    check_controllable(matrix.shape[1], len(matrix))
    analysis = np.linalg.svd(matrix, full_matrices=False)[0].T
    share = measured.sum(axis=1) / max(int(measured.any(axis=0).sum()), 1)
    modes = np.where((share >= LEAST_MEASURED)[:, None], np.nan_to_num(loop.slopes) @ analysis.T, np.nan)
    if not np.isfinite(modes).any():
        raise InputError("recording: expected frames with most slopes measured, got none")
    unknown: dict[str, Any] = dict.fromkeys(("standard_errors", "covariance_xy", "prior_std", "cells"))
    return Modes(replace(loop, slopes=modes, interaction_matrix=analysis @ matrix, **unknown), analysis)


def plateau(modes: Floats) -> SlopeNoise:
    """Return the noise of each mode, from where its spectrum is flat.

    Parameters
    ----------
    modes : (frames, k) array
        Open-loop modes; NaN where not measured.
    """
    count = (1 - 2 * _PLATEAU) * np.isfinite(modes).sum(axis=0)
    error = np.where(count > 0, np.sqrt(_OF_MEDIAN / np.maximum(count, 1)), np.nan)
    return SlopeNoise(spectra_of_modes(modes)[1], error, _NOT_FLAT)


def spectra_of_modes(modes: Floats, without: slice = slice(0)) -> tuple[Floats, Floats]:
    """Return power spectra at all frequencies, (frequencies, k), and the noise of each mode.

    Some frames are left out, after which the pieces are as long as with them.
    """
    measured = np.isfinite(modes).all(axis=1)
    rows = np.arange(len(modes))
    filled = np.array([np.interp(rows, rows[measured], values[measured]) for values in modes.T]).T
    length, used = length_of_piece(len(modes)), np.delete(filled, without, axis=0)
    used -= used.mean(axis=0)
    frequency, power = scipy.signal.welch(used, nperseg=length, detrend=False, return_onesided=False, axis=0)
    noise = np.median(power[np.abs(frequency) > _PLATEAU], axis=0)
    return power, np.maximum(noise, _LEAST_NOISE * np.var(filled, axis=0))


def length_of_piece(frames: int) -> int:
    """Return the number of frames of a piece of a spectrum."""
    power_of_two: int = 2 ** math.floor(math.log2(max(frames / _PIECES, _SHORTEST)))
    return min(power_of_two, _LONGEST, frames)
