"""Delay and centroid gain of a closed loop from its slopes and commands.

With the right delay and gain, slopes without the mirror's part are turbulence and white noise. With wrong
ones the noise that the loop has sent to the mirror is left in them. So delay, gain, strengths of von Karman
turbulence carried by winds of several speeds from anywhere, its spatial averaging, and noise are those for
which the cross-spectra of the slopes are the most likely (Whittle). The gain of given spectra is generalised
least squares. Its error grows with the deviation of the measured spectra from the fitted ones.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.errors import InputError
from faintspot.loop.control.identification.slope_spectra import SlopeSpectra
from faintspot.loop.slope_covariance import SlopeTurbulence

_WINDOW, _WINDOW_S = 128, 0.52  # frames; a longer window if the frame rate is so high that these last longer
_FEWEST_PIECES, _FEWEST_LONG_PIECES = 4, 12
MOST_DELAY, _USUAL_DELAY = 5, 3
_CLEARLY = 9.0  # logarithm of the likelihood ratio, for a longer delay than the usual ones to be preferred
_STEP = 0.1  # of fractional delays
GAINS = 0.1, 1.6
"""Limits of the search for the centroid gain."""
_START_GAIN = 0.6
_MODEL_ERROR = 0.05  # frames: spectra of real slopes differ from the theory
_GAIN_ERROR = 0.04  # absolute and relative, likewise
_AVERAGED = 0.4, 0.7, 1.0, 1.4
"""Values of `SlopeTurbulence.averaged` of which the likeliest is used: sharper or smoother slopes."""
_AXES_ERROR = 0.09  # of the gain of x relative to y, likewise: in loops of three packages, of equal gains
_SURE = 3.0  # standard errors
_SPEEDS_M_PER_S = (1.0, 3.0, 6.0, 10.0, 15.0, 22.0, 32.0)
_DIRECTIONS = 4  # of half a turn: opposite winds have the same spectrum
_SMOOTH = 0.015, 0.03, 0.06, 0.12
"""Parts of the frame rate beyond which parts of the turbulence fall as a Gaussian: without fine structure it
falls more steeply than that of von Karman, which a gain that is too small explains, too."""
_MOST_SUBAPERTURES, _MOST_MODES = 160, 36
"""Side by side: in sparse ones structure between them is taken for large modes."""
_UPDATES, _FEW_UPDATES, _POWER = 60, 15, 0.9
_LEAST_STRENGTH = 1e-6  # of the largest: weaker turbulence is none
_LEAST_INFORMATION, _MOST_ERROR = 0.01, 1.0
"""Part of the information on the gain that unknown strengths leave at least; largest error of a gain."""
_BATCH = 64  # pieces at a time
INDEPENDENT = 0.55  # part of half-overlapping pieces
FEWEST_SUBAPERTURES = 3
"""Fewer show only tip and tilt, in which vibrations cannot be separated from turbulence."""


@dataclass(frozen=True)
class LoopDelay:
    """Delay and centroid gain with standard errors."""

    delay_frames: float
    """The command computed from frame k acts first during frame k + delay; fractions: within it."""
    delay_error: float
    gain: float
    """Centroid gain relative to the interaction matrix."""
    gain_error: float
    x_to_y: float = 1.0
    """Gain of x relative to y that is used; `gain` is their geometric mean."""
    measured_x_to_y: float = math.nan
    x_to_y_error: float = math.nan
    misfit: float = 1.0
    """Rms deviation of spectra from the fitted ones, in units of that of chance; 1 or more."""

    def for_control(self) -> LoopDelay:
        """Return the same with a gain that a controller may assume: larger by half its error.

        A gain assumed too small makes the loop unstable; one too large by as much only makes it slower.
        Where the spectra do not fit, it is larger by up to its error.
        """
        return replace(self, gain=min(self.gain + self.gain_error * (1 - 0.5 / self.misfit), max(GAINS)))

    @property
    def gain_summary(self) -> str:
        """Return the centroid gain in words."""
        return f"centroid gain {self.gain:.3f} +- {self.gain_error:.3f}"

    def row(self) -> Floats:
        """Return delay, gain and gain of x relative to y as measured, each with its standard error, (6,)."""
        axes = self.measured_x_to_y, self.x_to_y_error
        return np.array([self.delay_frames, self.delay_error, self.gain, self.gain_error, *axes])

    def gains(self, n: int) -> Floats:
        """Return the centroid gain of each slope of n sub-apertures, (2 n,)."""
        root = math.sqrt(self.x_to_y)
        return np.repeat([self.gain * root, self.gain / root], n)


class DelayFits:
    """Fits of delay and centroid gain to the cross-spectra of a closed loop.

    The spectra of the model are real, as opposite winds have the same; so only real parts count.

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
    axis : int, optional
        0: slopes along x alone, 1: along y alone.

    Raises
    ------
    InputError
        When there are fewer than 3 sub-apertures, because vibrations change tip and tilt, or fewer than 4
        pieces of 128 consecutive frames, half overlapping.
    """

    def __init__(
        self,
        slopes_px: Floats,
        sent_px: Floats,
        run: NDArray[np.int64],
        site: SlopeTurbulence,
        rate_hz: float,
        axis: int | None = None,
    ) -> None:
        n = len(site.positions_m)
        if n < FEWEST_SUBAPERTURES:
            fewest = f"{FEWEST_SUBAPERTURES} sub-apertures or more, as vibrations hide it in tip and tilt"
            raise InputError(f"recording: expected {fewest}, got {n}")
        apart = np.hypot(*(site.positions_m - site.positions_m.mean(axis=0)).T)
        kept = np.sort(np.argsort(apart, kind="stable")[:_MOST_SUBAPERTURES])
        columns = np.concatenate([kept, kept + n])
        site = replace(site, positions_m=site.positions_m[kept])
        window = np.hanning(_window_length(run, rate_hz) + 2)[1:-1]
        window /= np.linalg.norm(window)
        basis = _modes(site, axis)
        slopes, sent = ((values - values.mean(axis=0))[:, columns] @ basis for values in (slopes_px, sent_px))
        products, pieces = cross_spectra(slopes, sent, run, window)
        self._fits = [
            _Fit(
                products, _turbulence(replace(site, averaged=averaged), rate_hz, window, basis, axis), pieces
            )
            for averaged in _AVERAGED
        ]

    def of(self, delay_frames: float) -> LoopDelay:
        """Return the gain for a delay that is known."""
        found = self._fitted(delay_frames)
        misfit = self._fits[found].misfit(delay_frames)
        gain, error = self._fits[found].of(delay_frames, 0)[0], self._fits[found].gain_error(delay_frames)
        near = [fit.of(delay_frames, 0)[0] for fit in self._fits[max(found - 1, 0) : found + 2]]
        error = math.hypot(error, np.ptp(near) / 2, _model_error(gain, misfit))
        return LoopDelay(delay_frames, 0.0, gain, error, misfit=misfit)

    def gains_of(self, delay_frames: float) -> Floats:
        """Return the gain for a known delay, its error as far as frames and noise cause it, and minus the
        logarithm of the likelihood, for each averaging of turbulence, (averagings, 3).
        """
        self._fitted(delay_frames)
        rows = []
        for fit in self._fits:
            gain, unlikely = fit.of(delay_frames, 0)
            rows.append([gain, fit.gain_error(delay_frames), unlikely])
        return np.array(rows)

    def best(self) -> LoopDelay:
        """Return delay and gain, averaged over the delays that are likely."""
        for fit in self._fits:
            fit.begin()
            fit.of(2.0)
        tried = {
            (fit, delay): fit.of(delay, _FEW_UPDATES)[-1]
            for delay in range(1, MOST_DELAY + 1)
            for fit in self._fits
        }
        for most in _USUAL_DELAY, MOST_DELAY:
            fit, whole = min((key for key in tried if key[1] <= most), key=tried.__getitem__)
            fit.begin()
            fit.of(whole)
            misfit = fit.misfit(whole)
            likely = {
                delay
                for (_, delay), unlikely in tried.items()
                if unlikely < tried[fit, whole] + _CLEARLY * misfit**2
            }
            if min(tried.values()) > tried[fit, whole] - _CLEARLY * misfit**2:
                break
        first, last = min(likely) - 1.0, max(likely) + 1.0
        delays = np.arange(max(first, 1.0), min(last, most) + 0.5 * _STEP, _STEP)
        values = np.zeros((len(delays), 2))
        for side in np.flatnonzero(delays > whole), np.flatnonzero(delays <= whole)[::-1]:
            fit.begin()
            fit.of(whole)
            values[side] = [fit.of(delay, _FEW_UPDATES) for delay in delays[side]]
        weight = np.exp((values[:, 1].min() - values[:, 1]) / misfit**2)
        weight /= weight.sum()
        delay = float(weight @ delays)
        of_frames = math.sqrt(float(weight @ (delays - delay) ** 2))
        delay_error = math.hypot(of_frames, _STEP / math.sqrt(12), _MODEL_ERROR * misfit)
        known = self.of(delay)
        of_delay = math.sqrt(float(weight @ (values[:, 0] - weight @ values[:, 0]) ** 2))
        return replace(known, delay_error=delay_error, gain_error=math.hypot(known.gain_error, of_delay))

    def _fitted(self, delay_frames: float) -> int:
        """Return the number of the likeliest averaging for a known delay, whose fits are made."""
        for fit in self._fits:
            fit.begin()
        return int(np.argmin([fit.of(delay_frames)[-1] for fit in self._fits]))


class _Fit:
    """Gain, and strengths of turbulence of given spectra, fitted to the cross-spectra of a loop."""

    def __init__(self, products: Floats, parts: Floats, pieces: int) -> None:
        self._products, self._parts = products, parts
        self._flat = parts.reshape(len(parts), -1)
        self._independent = INDEPENDENT * pieces
        self.begin()

    def begin(self) -> None:
        """Start from equal strengths."""
        level = np.trace(self._products[:, 0, 0], axis1=1, axis2=2).sum()
        self._strength = level / np.trace(self._parts, axis1=2, axis2=3).sum(axis=1) / len(self._parts)
        self._gain = _START_GAIN

    def of(self, delay: float, updates: int = _UPDATES) -> tuple[float, float]:
        """Return gain and minus the logarithm of the likelihood after more updates.

        Strengths are kept from one delay to the next.
        """
        crossed, squared = self._of_delay(delay)
        strength, gain = self._strength, self._gain
        for _ in range(updates):
            inverse = np.linalg.inv(self._model(strength))
            explained = inverse @ self._measured(gain, crossed, squared) @ inverse
            both = (self._flat @ matrices.swapaxes(1, 2).ravel() for matrices in (explained, inverse))
            strength = strength * np.maximum(np.divide(*both), 1e-9) ** _POWER
            curvature, slope = (float((inverse * matrix).sum()) for matrix in (squared, crossed))
            gain = float(np.clip(0.5 * slope / max(curvature, 1e-300), *GAINS))
        self._strength, self._gain = np.maximum(strength, 1e-12 * strength.max()), gain
        model, measured = self._model(self._strength), self._measured(gain, crossed, squared)
        unlikely = float(np.linalg.slogdet(model)[1].sum() + (np.linalg.inv(model) * measured).sum())
        return gain, self._independent * unlikely

    def gain_error(self, delay: float) -> float:
        """Return the standard error of the latest fit's gain, with the strengths unknown (Fisher)."""
        crossed, squared = self._of_delay(delay)
        used = self._strength > _LEAST_STRENGTH * self._strength.max()
        inverse = np.linalg.inv(self._model(self._strength))
        parts = inverse @ (self._parts[used] * self._strength[used, None, None, None])
        change = inverse @ (2 * self._gain * squared - crossed)
        flat, turned = (values.reshape(len(parts), -1) for values in (parts, parts.swapaxes(-1, -2)))
        both = flat @ change.swapaxes(-1, -2).ravel()
        alone = 2 * float((inverse * squared).sum())  # with the strengths known
        information = max(alone - both @ np.linalg.pinv(flat @ turned.T) @ both, _LEAST_INFORMATION * alone)
        return min(1 / math.sqrt(max(self._independent * information, 1e-300)), _MOST_ERROR)

    def misfit(self, delay: float) -> float:
        """Return the rms deviation of the latest fit's whitened power, in that of chance; 1 or more.

        Of the mean over all modes, frequency by frequency.
        """
        measured = self._measured(self._gain, *self._of_delay(delay))
        whitened = (np.linalg.inv(self._model(self._strength)) * measured).sum(axis=(1, 2))
        modes = self._parts.shape[-1]
        deviation = float(np.square(whitened / modes - 1).mean())
        return max(1.0, math.sqrt(self._independent * modes * deviation))

    def _of_delay(self, delay: float) -> tuple[Floats, Floats]:
        """Return products of slopes with the commands of a delay, and of these with themselves."""
        first, part = min(int(delay), MOST_DELAY), delay - min(int(delay), MOST_DELAY)
        share = {first: 1 - part, first + 1: part}
        lags, weights = list(share), np.array(list(share.values()))
        crossed = np.tensordot(self._products[:, 0, lags], weights, (1, 0))
        within = self._products[:, lags][:, :, lags]
        squared = np.tensordot(within, np.outer(weights, weights), ((1, 2), (0, 1)))
        return crossed + crossed.swapaxes(1, 2), np.asarray(squared)

    def _model(self, strength: Floats) -> Floats:
        return np.asarray((strength @ self._flat).reshape(self._parts.shape[1:]))

    def _measured(self, gain: float, crossed: Floats, squared: Floats) -> Floats:
        return np.asarray(self._products[:, 0, 0] - gain * crossed + gain**2 * squared)


def with_axes(
    delay: LoopDelay,
    slopes_px: Floats,
    sent_px: Floats,
    run: NDArray[np.int64],
    site: SlopeTurbulence,
    rate_hz: float,
) -> LoopDelay:
    """Return delay and centroid gain with the gain of x relative to y, used if it differs from 1 for sure.

    Parameters as for `DelayFits`, which has found `delay`.
    """
    loop = sent_px, run, site, rate_hz
    of_axes = np.array([DelayFits(slopes_px, *loop, axis).gains_of(delay.delay_frames) for axis in (0, 1)])
    alike = int(np.argmin(of_axes[..., 2].sum(axis=0)))  # turbulence is averaged alike along both axes
    gains, errors = of_axes[:, alike, :2].T
    ratio = float(gains[0] / gains[1])
    error = ratio * math.hypot(*(errors / gains), _AXES_ERROR * delay.misfit)
    found = replace(delay, measured_x_to_y=ratio, x_to_y_error=error)
    if abs(math.log(ratio)) < _SURE * error / ratio:
        return found
    # Both axes together tell the gain better than each alone.
    equal = slopes_px / replace(found, gain=1.0, x_to_y=ratio).gains(len(site.positions_m))
    fit = DelayFits(equal, *loop).of(delay.delay_frames).for_control()
    return replace(found, gain=fit.gain, gain_error=fit.gain_error, x_to_y=ratio, misfit=fit.misfit)


def _model_error(gain: float, misfit: float) -> float:
    """Return the error of a gain as spectra of real slopes differ from the theory."""
    return _GAIN_ERROR * math.hypot(1, gain) * misfit


def _modes(site: SlopeTurbulence, axis: int | None) -> Floats:
    """Return an orthonormal basis (2 n, modes) without tip and tilt, where vibrations are.

    Of slopes along both axes or one; from those with the most turbulence to those with the least.
    """
    n = len(site.positions_m)
    axes = np.eye(2) if axis is None else np.diag(np.eye(2)[axis])
    without = np.kron(axes, np.eye(n) - 1 / n)
    covariance = replace(site, pixel_scale_rad=1.0).covariance_px2()  # the same modes in any unit
    modes = int(axes.trace()) * (n - 1)
    vectors = np.linalg.eigh(without @ covariance @ without)[1][:, ::-1][:, :modes]
    most = _MOST_MODES * modes // (2 * n - 2)
    return np.asarray(vectors[:, np.unique(np.geomspace(1, modes, most).astype(int)) - 1])


def _window_length(run: NDArray[np.int64], rate_hz: float) -> int:
    """Return the number of frames of a piece: more at high frame rates, as turbulence is slow then."""
    length, longest = _WINDOW, int(np.bincount(run - run.min()).max())
    while 2 * length <= _WINDOW_S * rate_hz and (_FEWEST_LONG_PIECES + 1) * length <= longest:
        length *= 2
    return length


def cross_spectra(slopes: Floats, sent: Floats, run: NDArray[np.int64], window: Floats) -> tuple[Floats, int]:
    """Return cross-spectra (frequencies, 1 + lags, 1 + lags, m, m) of slopes and earlier commands."""
    lags, length, m = MOST_DELAY + 1, len(window), slopes.shape[1]
    starts = [
        start
        for start in range(lags, len(slopes) - length + 1, length // 2)
        if run[start - lags] == run[start + length - 1]
    ]
    if len(starts) < _FEWEST_PIECES:
        gaps = f" with {len(np.unique(run)) - 1} gaps" if run[0] != run[-1] else ""
        needed = length * (_FEWEST_PIECES + 1) // 2 + lags
        raise InputError(f"recording: expected {needed} consecutive frames, got {len(slopes)}{gaps}")
    total: Floats | float = 0.0
    for first in range(0, len(starts), _BATCH):
        pieces = []
        for start in starts[first : first + _BATCH]:
            parts = [slopes[start : start + length]]
            parts += [sent[start - lag : start - lag + length] for lag in range(1, lags + 1)]
            transformed = np.fft.rfft(np.array(parts) * window[:, None], axis=1)[:, bins_of(length)]
            flat = transformed.transpose(1, 2, 0).reshape(transformed.shape[1], -1)
            pieces += [flat.real, flat.imag]
        batch = np.array(pieces).transpose(1, 2, 0)
        total = total + batch @ batch.swapaxes(1, 2)
    shape = -1, m, 1 + lags, m, 1 + lags
    return np.ascontiguousarray(
        (np.asarray(total) / len(starts)).reshape(shape).transpose(0, 2, 4, 1, 3)
    ), len(starts)


def bins_of(length: int) -> NDArray[np.int64]:
    """Return every second frequency, as neighbours are alike under the window."""
    return np.arange(1, length // 2, 2)


def _turbulence(
    site: SlopeTurbulence, rate_hz: float, window: Floats, basis: Floats, axis: int | None
) -> Floats:
    """Return cross-spectra (parts + 1, frequencies, m, m) of turbulence and of white noise.

    The turbulence is from anywhere; of one axis, it comes from each direction, as winds along x change slopes
    along x more than those along y.
    """
    bins = bins_of(len(window))
    spectra = SlopeSpectra(site, 1 / rate_hz, window, bins, max(_SPEEDS_M_PER_S) * len(window) / rate_hz)
    tables, _ = spectra.tables(site.outer_scale_m)
    angles = np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
    parts = []
    for speed in _SPEEDS_M_PER_S:
        winds = speed * np.column_stack([np.cos(angles), np.sin(angles)])
        full = [spectra.of_wind(wind, tables) for wind in winds]
        for distinct in full if axis is not None else [np.mean(full, axis=0)]:
            parts.append(basis.T @ spectra.matrices(distinct).real @ basis)
    noise = np.broadcast_to(np.eye(basis.shape[1]), parts[0].shape)
    falls = np.exp(-np.square(np.divide.outer(bins / len(window), _SMOOTH).T))[..., None, None]
    return np.array([*parts, *(fall * part for fall in falls for part in parts), noise])
