"""Delay and centroid gain of a closed loop from its slopes and commands.

With the right delay and gain, slopes without the mirror's part are turbulence and white noise. With wrong
ones the noise that the loop has sent to the mirror is left in them. So delay, gain, strengths of von Karman
turbulence carried by winds of several speeds from anywhere, and noise are those for which the cross-spectra
of the slopes are the most likely (Whittle). The gain of given spectra is generalised least squares.
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

_WINDOW, _WINDOW_S = 128, 0.52  # frames; a longer window if the frame rate is so high that these last longer
_FEWEST_PIECES, _FEWEST_LONG_PIECES = 8, 12
_MOST_DELAY = 5
_STEP = 0.1  # of fractional delays
GAINS = 0.1, 1.6
"""Limits of the search for the centroid gain."""
_START_GAIN = 0.6
_MODEL_ERROR = 0.05  # frames: spectra of real slopes differ from the theory
_GAIN_ERROR = 0.03  # absolute and relative, likewise
_AXES_ERROR = 0.09  # of the gain of x relative to y, likewise: rms in loops of three packages, of equal gains
_SURE = 3.0  # standard errors
_SPEEDS_M_PER_S = (1.0, 3.0, 6.0, 10.0, 15.0, 22.0, 32.0)
_DIRECTIONS = 4  # of half a turn: opposite winds have the same spectrum
_MOST_SUBAPERTURES, _MOST_MODES = 160, 36
"""Side by side: in sparse ones structure between them is taken for large modes."""
_UPDATES, _FEW_UPDATES, _POWER = 60, 15, 0.9
_BATCH = 64  # pieces at a time
_INDEPENDENT = 0.55  # part of half-overlapping pieces
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
        When there are fewer than 3 sub-apertures, because vibrations change tip and tilt, or fewer than 8
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
            raise InputError(
                f"recording: expected {FEWEST_SUBAPERTURES} sub-apertures or more, as vibrations hide it in "
                f"tip and tilt, got {n}"
            )
        apart = np.hypot(*(site.positions_m - site.positions_m.mean(axis=0)).T)
        kept = np.sort(np.argsort(apart, kind="stable")[:_MOST_SUBAPERTURES])
        columns = np.concatenate([kept, kept + n])
        site = replace(site, positions_m=site.positions_m[kept])
        window = np.hanning(_window_length(run, rate_hz) + 2)[1:-1]
        window /= np.linalg.norm(window)
        basis = _modes(site, axis)
        slopes, sent = ((values - values.mean(axis=0))[:, columns] @ basis for values in (slopes_px, sent_px))
        self._products, pieces = _products(slopes, sent, run, window)
        self._parts = _turbulence(site, rate_hz, window, basis)
        self._flat = self._parts.reshape(len(self._parts), -1)
        self._independent = _INDEPENDENT * pieces
        self._begin()

    def _begin(self) -> None:
        """Start from equal strengths."""
        level = np.trace(self._products[:, 0, 0], axis1=1, axis2=2).sum()
        self._strength = level / np.trace(self._parts, axis1=2, axis2=3).sum(axis=1) / len(self._parts)
        self._gain = _START_GAIN

    def of(self, delay_frames: float) -> LoopDelay:
        """Return the gain for a delay that is known."""
        self._begin()
        gain, gain_error, _ = self._fit(delay_frames, _UPDATES)
        return LoopDelay(delay_frames, 0.0, gain, math.hypot(gain_error, _model_error(gain)))

    def gain_of(self, delay_frames: float) -> tuple[float, float]:
        """Return the gain for a known delay, and its error as far as frames and noise cause it."""
        self._begin()
        return self._fit(delay_frames, _UPDATES)[:2]

    def best(self) -> LoopDelay:
        """Return delay and gain, averaged over the delays that are likely."""
        self._begin()
        self._fit(2.0, _UPDATES)
        whole = min(range(1, _MOST_DELAY + 1), key=lambda delay: self._fit(delay, _FEW_UPDATES)[-1])
        delays = np.arange(max(whole - 1.0, 1.0), min(whole + 1.0, _MOST_DELAY) + 0.5 * _STEP, _STEP)
        values = np.array([self._fit(delay, _FEW_UPDATES) for delay in delays])
        weight = np.exp(values[:, 2].min() - values[:, 2])
        weight /= weight.sum()
        delay, gain = float(weight @ delays), float(weight @ values[:, 0])
        delay_error = math.hypot(
            math.sqrt(float(weight @ (delays - delay) ** 2)), _STEP / math.sqrt(12), _MODEL_ERROR
        )
        of_delay = math.sqrt(float(weight @ (values[:, 0] - gain) ** 2))
        gain_error = math.hypot(of_delay, float(weight @ values[:, 1]), _model_error(gain))
        return LoopDelay(delay, delay_error, gain, gain_error)

    def _fit(self, delay: float, updates: int) -> tuple[float, float, float]:
        """Return gain, its standard error, and the misfit: minus the logarithm of the likelihood.

        Strengths are kept from one delay to the next.
        """
        first, part = min(int(delay), _MOST_DELAY), delay - min(int(delay), _MOST_DELAY)
        share = {first: 1 - part, first + 1: part}
        lags, weights = list(share), np.array(list(share.values()))
        crossed = np.tensordot(self._products[:, 0, lags], weights, (1, 0))
        within = self._products[:, lags][:, :, lags]
        squared = np.tensordot(within, np.outer(weights, weights), ((1, 2), (0, 1)))
        crossed = crossed + crossed.swapaxes(1, 2)
        strength, gain = self._strength, self._gain
        for _ in range(updates):
            inverse = np.linalg.inv(self._model(strength))
            explained = inverse @ self._measured(gain, crossed, squared) @ inverse
            both = (self._flat @ matrices.swapaxes(1, 2).ravel() for matrices in (explained, inverse))
            strength = strength * np.maximum(np.divide(*both), 1e-9) ** _POWER
            curvature, slope = (float((inverse * matrix).sum()) for matrix in (squared, crossed))
            gain = float(np.clip(0.5 * slope / max(curvature, 1e-300), *GAINS))
        self._strength, self._gain = np.maximum(strength, 1e-12 * strength.max()), gain
        model, measured = self._model(strength), self._measured(gain, crossed, squared)
        misfit = float(np.linalg.slogdet(model)[1].sum() + (np.linalg.inv(model) * measured).sum())
        error = 1 / math.sqrt(2 * self._independent * max(curvature, 1e-300))
        return gain, error, self._independent * misfit

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
    gains, errors = np.transpose(
        [DelayFits(slopes_px, *loop, axis).gain_of(delay.delay_frames) for axis in (0, 1)]
    )
    ratio = float(gains[0] / gains[1])
    error = ratio * math.hypot(*(errors / gains), _AXES_ERROR)
    found = replace(delay, measured_x_to_y=ratio, x_to_y_error=error)
    if abs(math.log(ratio)) < _SURE * error / ratio:
        return found
    # Both axes together tell the gain better than each alone.
    alike = slopes_px / replace(found, gain=1.0, x_to_y=ratio).gains(len(site.positions_m))
    fit = DelayFits(alike, *loop).of(delay.delay_frames)
    return replace(found, gain=fit.gain, gain_error=fit.gain_error, x_to_y=ratio)


def _model_error(gain: float) -> float:
    """Return the error of a gain as spectra of real slopes differ from the theory."""
    return _GAIN_ERROR * math.hypot(1, gain)


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


def _products(slopes: Floats, sent: Floats, run: NDArray[np.int64], window: Floats) -> tuple[Floats, int]:
    """Return cross-spectra (frequencies, 1 + lags, 1 + lags, m, m) of slopes and earlier commands."""
    lags, length, m = _MOST_DELAY + 1, len(window), slopes.shape[1]
    starts = [
        start
        for start in range(lags, len(slopes) - length + 1, length // 2)
        if run[start - lags] == run[start + length - 1]
    ]
    if len(starts) < _FEWEST_PIECES:
        gaps = f" with {len(np.unique(run)) - 1} gaps" if run[0] != run[-1] else ""
        raise InputError(
            f"recording: expected {length * (_FEWEST_PIECES + 1) // 2} consecutive frames, got {len(slopes)}"
            f"{gaps}"
        )
    total: Floats | float = 0.0
    for first in range(0, len(starts), _BATCH):
        pieces = []
        for start in starts[first : first + _BATCH]:
            parts = [slopes[start : start + length]]
            parts += [sent[start - lag : start - lag + length] for lag in range(1, lags + 1)]
            transformed = np.fft.rfft(np.array(parts) * window[:, None], axis=1)[:, _bins(length)]
            flat = transformed.transpose(1, 2, 0).reshape(transformed.shape[1], -1)
            pieces += [flat.real, flat.imag]
        batch = np.array(pieces).transpose(1, 2, 0)
        total = total + batch @ batch.swapaxes(1, 2)
    shape = -1, m, 1 + lags, m, 1 + lags
    return np.ascontiguousarray(
        (np.asarray(total) / len(starts)).reshape(shape).transpose(0, 2, 4, 1, 3)
    ), len(starts)


def _bins(length: int) -> NDArray[np.int64]:
    """Return every second frequency, as neighbours are alike under the window."""
    return np.arange(1, length // 2, 2)


def _turbulence(site: SlopeTurbulence, rate_hz: float, window: Floats, basis: Floats) -> Floats:
    """Return cross-spectra (speeds + 1, frequencies, m, m) of turbulence from anywhere and of white noise."""
    bins = _bins(len(window))
    spectra = SlopeSpectra(site, 1 / rate_hz, window, bins, max(_SPEEDS_M_PER_S) * len(window) / rate_hz)
    tables, _ = spectra.tables(site.outer_scale_m)
    angles = np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
    parts = []
    for speed in _SPEEDS_M_PER_S:
        winds = speed * np.column_stack([np.cos(angles), np.sin(angles)])
        full = spectra.matrices(np.mean([spectra.of_wind(wind, tables) for wind in winds], axis=0))
        parts.append(basis.T @ full.real @ basis)
    noise = np.broadcast_to(np.eye(basis.shape[1]), parts[0].shape)
    return np.array([*parts, noise])
