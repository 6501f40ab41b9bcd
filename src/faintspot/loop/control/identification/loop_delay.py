"""Delay and centroid gain of a closed loop from its slopes and commands.

With the right delay and gain, slopes without the mirror's part are turbulence and white noise. With wrong
ones the noise that the loop has sent to the mirror is left in them. So delay, gain, strengths of von Karman
turbulence carried by winds of several speeds from anywhere, and noise are those for which the cross-spectra
of the slopes are the most likely (Whittle). The gain of given spectra is generalised least squares.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.loop.control.identification.slope_spectra import SlopeSpectra
from faintspot.loop.turbulence.slope_covariance import SlopeTurbulence

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

_WINDOW = 128  # frames
_FEWEST_PIECES = 8
_MOST_DELAY = 5
_STEP = 0.1  # of fractional delays
_GAINS = 0.1, 1.6
_START_GAIN = 0.6
_MODEL_ERROR = 0.05  # frames: spectra of real slopes differ from the theory
_GAIN_ERROR = 0.03  # absolute and relative, likewise
_AXES_ERROR = 0.09  # of the gain of x relative to y, likewise: rms in loops of three packages, of equal gains
_SURE = 3.0  # standard errors
_SPEEDS_M_PER_S = (1.0, 3.0, 6.0, 10.0, 15.0, 22.0, 32.0)
_DIRECTIONS = 4  # of half a turn: opposite winds have the same spectrum
_MOST_SUBAPERTURES, _MOST_MODES = 40, 36
_UPDATES, _FEW_UPDATES, _POWER = 60, 15, 0.9
_INDEPENDENT = 0.55  # part of half-overlapping pieces
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
    fits = _Fits.of_loop(slopes_px, sent_px, run, site, rate_hz)
    if delay_frames is not None:
        gain, gain_error, _ = fits.of(delay_frames, _UPDATES)
        return LoopDelay(delay_frames, 0.0, gain, math.hypot(gain_error, _model_error(gain)))
    fits.of(2.0, _UPDATES)
    whole = min(range(1, _MOST_DELAY + 1), key=lambda delay: fits.of(delay, _FEW_UPDATES)[-1])
    delays = np.arange(max(whole - 1.0, 1.0), min(whole + 1.0, _MOST_DELAY) + 0.5 * _STEP, _STEP)
    values = np.array([fits.of(delay, _FEW_UPDATES) for delay in delays])
    weight = np.exp(values[:, 2].min() - values[:, 2])
    weight /= weight.sum()
    delay, gain = float(weight @ delays), float(weight @ values[:, 0])
    delay_error = math.hypot(
        math.sqrt(float(weight @ (delays - delay) ** 2)), _STEP / math.sqrt(12), _MODEL_ERROR
    )
    of_delay = math.sqrt(float(weight @ (values[:, 0] - gain) ** 2))
    gain_error = math.hypot(of_delay, float(weight @ values[:, 1]), _model_error(gain))
    return LoopDelay(delay, delay_error, gain, gain_error)


def with_axes(
    delay: LoopDelay,
    slopes_px: Floats,
    sent_px: Floats,
    run: NDArray[np.int64],
    site: SlopeTurbulence,
    rate_hz: float,
) -> LoopDelay:
    """Return delay and centroid gain with the gain of x relative to y, used if it differs from 1 for sure.

    Parameters as for `loop_delay`, which has found `delay`.
    """
    gains, errors = np.transpose(
        [
            _Fits.of_loop(slopes_px, sent_px, run, site, rate_hz, axis).of(delay.delay_frames, _UPDATES)[:2]
            for axis in (0, 1)
        ]
    )
    ratio = float(gains[0] / gains[1])
    error = ratio * math.hypot(*(errors / gains), _AXES_ERROR)
    found = replace(delay, measured_x_to_y=ratio, x_to_y_error=error)
    if abs(math.log(ratio)) < _SURE * error / ratio:
        return found
    # Both axes together tell the gain better than each alone.
    alike = slopes_px / replace(found, gain=1.0, x_to_y=ratio).gains(len(site.positions_m))
    fit = loop_delay(alike, sent_px, run, site, rate_hz, delay.delay_frames)
    return replace(found, gain=fit.gain, gain_error=fit.gain_error, x_to_y=ratio)


def _model_error(gain: float) -> float:
    """Return the error of a gain as spectra of real slopes differ from the theory."""
    return _GAIN_ERROR * math.hypot(1, gain)


class _Fits:
    """Most likely gains for delays; strengths are kept from one delay to the next."""

    def __init__(self, products: Complex, parts: Complex, pieces: int) -> None:
        self._products, self._parts = products, parts
        self._independent = _INDEPENDENT * pieces
        level = np.trace(products[:, 0, 0], axis1=1, axis2=2).real.sum()
        each = np.trace(parts, axis1=2, axis2=3).real.sum(axis=1)
        self._strength = level / each / len(parts)
        self._gain = _START_GAIN

    @classmethod
    def of_loop(
        cls,
        slopes_px: Floats,
        sent_px: Floats,
        run: NDArray[np.int64],
        site: SlopeTurbulence,
        rate_hz: float,
        axis: int | None = None,
    ) -> Self:
        """Return the fits of a loop, of slopes along both axes or one; see `loop_delay`."""
        n = len(site.positions_m)
        if n < FEWEST_SUBAPERTURES:
            raise InputError(
                f"recording: expected {FEWEST_SUBAPERTURES} sub-apertures or more, as vibrations hide it in "
                f"tip and tilt, got {n}"
            )
        kept = np.arange(n)[:: math.ceil(n / _MOST_SUBAPERTURES)]
        columns = np.concatenate([kept, kept + n])
        site = replace(site, positions_m=site.positions_m[kept])
        window = np.hanning(_WINDOW + 2)[1:-1]
        window /= np.linalg.norm(window)
        basis = _modes(site, axis)
        slopes, sent = ((values - values.mean(axis=0))[:, columns] @ basis for values in (slopes_px, sent_px))
        products, pieces = _products(slopes, sent, run, window)
        return cls(products, _turbulence(site, rate_hz, window, basis), pieces)

    def of(self, delay: float, updates: int) -> tuple[float, float, float]:
        """Return gain, its standard error, and the misfit: minus the logarithm of the likelihood."""
        first, part = min(int(delay), _MOST_DELAY), delay - min(int(delay), _MOST_DELAY)
        share = {first: 1 - part, first + 1: part}
        lags, weights = list(share), np.array(list(share.values()))
        crossed = np.tensordot(self._products[:, 0, lags], weights, (1, 0))
        within = self._products[:, lags][:, :, lags]
        squared = np.tensordot(within, np.outer(weights, weights), ((1, 2), (0, 1)))
        crossed = crossed + crossed.conj().swapaxes(1, 2)
        strength, gain = self._strength, self._gain
        for _ in range(updates):
            measured = self._products[:, 0, 0] - gain * crossed + gain**2 * squared
            inverse = np.linalg.inv(np.tensordot(strength, self._parts, 1))
            explained = inverse @ measured @ inverse
            both = (
                np.einsum("sfij,fji->s", self._parts, matrices, optimize=True).real
                for matrices in (explained, inverse)
            )
            strength = strength * np.maximum(np.divide(*both), 1e-9) ** _POWER
            curvature = float((inverse * squared.swapaxes(1, 2)).sum().real)
            slope = float((inverse * crossed.swapaxes(1, 2)).sum().real)
            gain = float(np.clip(0.5 * slope / max(curvature, 1e-300), *_GAINS))
        self._strength, self._gain = np.maximum(strength, 1e-12 * strength.max()), gain
        model = np.tensordot(strength, self._parts, 1)
        measured = self._products[:, 0, 0] - gain * crossed + gain**2 * squared
        misfit = float(
            np.linalg.slogdet(model)[1].sum() + (np.linalg.inv(model) * measured.swapaxes(1, 2)).sum().real
        )
        error = 1 / math.sqrt(2 * self._independent * max(curvature, 1e-300))
        return gain, error, self._independent * float(misfit)


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


def _products(slopes: Floats, sent: Floats, run: NDArray[np.int64], window: Floats) -> tuple[Complex, int]:
    """Return cross-spectra (frequencies, 1 + lags, 1 + lags, m, m) of slopes and earlier commands."""
    lags = _MOST_DELAY + 1
    length, pieces = len(window), 0
    total: Complex | float = 0.0
    for start in range(lags, len(slopes) - length + 1, length // 2):
        if run[start - lags] != run[start + length - 1]:
            continue
        parts = [slopes[start : start + length]]
        parts += [sent[start - lag : start - lag + length] for lag in range(1, lags + 1)]
        transformed = np.fft.rfft(np.array(parts) * window[:, None], axis=1)[:, _bins(length)]
        flat = transformed.transpose(1, 0, 2).reshape(transformed.shape[1], -1)
        total = total + flat[:, :, None] * flat[:, None].conj()
        pieces += 1
    if pieces < _FEWEST_PIECES:
        raise InputError(
            f"recording: expected {length * (_FEWEST_PIECES + 1) // 2} consecutive frames, got {len(slopes)}"
        )
    m = slopes.shape[1]
    shape = -1, 1 + lags, m, 1 + lags, m
    return np.asarray(total / pieces).reshape(shape).transpose(0, 1, 3, 2, 4).copy(), pieces


def _bins(length: int) -> NDArray[np.int64]:
    """Return every second frequency, as neighbours are alike under the window."""
    return np.arange(1, length // 2, 2)


def _turbulence(site: SlopeTurbulence, rate_hz: float, window: Floats, basis: Floats) -> Complex:
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
    return np.array([*parts, noise], np.complex128)
