"""Open-loop slopes of a recorded loop, their noise, and other quantities measured from telemetry."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.errors import InputError
from faintspot.loop.control.base import OpenLoopTelemetry, without_prior
from faintspot.loop.control.identification.layers import Identified
from faintspot.loop.control.identification.loop_delay import GAINS, DelayFits, LoopDelay, with_axes
from faintspot.loop.control.identification.modal_delay import ModalFits, plateau
from faintspot.loop.control.identification.recording import Recording
from faintspot.loop.control.identification.slope_noise import noise_of_slopes
from faintspot.loop.slope_covariance import OUTER_SCALE_M, SlopeTurbulence
from faintspot.loop.turbulence_strength import TurbulenceStrength

FEWEST_FRAMES = 200
_MOST_LOST = 0.3  # of the frames; with more, the longest run without a gap is used
_SHORT_GAP, _MOST_FILLED = 3, 0.1  # frames that are interpolated for delay and gain, and part of all
_WHOLE_FRAMES = 0.1  # closer to a whole number of frames than this, a delay is taken for that
_LEAST_MEASURED = 0.5  # of a frame's slopes: the others count as 0 for delay and gain
_LEAST_SIGNAL = 1e-6  # of the slopes' variance, that their noise is taken to have


@dataclass(frozen=True, eq=False)
class OpenLoop:
    """Slopes of a recording on a regular grid of frames, in the interaction matrix's slopes."""

    telemetry: OpenLoopTelemetry
    residual: Floats
    """(frames, 2 n)"""
    run: NDArray[np.int64]
    """(frames,): numbers of runs without a gap."""
    variance: Floats
    """(2 n,): variance of the noise; of known standard errors the median."""
    variance_error: Floats
    """(2 n,): relative standard error of the measured variance; NaN where it is unknown."""
    shared_error: float
    """Relative standard error that all of these share."""

    def scaled(self, gain: float) -> OpenLoop:
        """Return the same with residual slopes multiplied by a gain."""
        telemetry, residual = self.telemetry, gain * self.residual
        slopes = telemetry.open_loop_px + residual - self.residual
        scaled = replace(telemetry.scaled(gain**2), open_loop_px=slopes)
        return replace(self, telemetry=scaled, residual=residual, variance=gain**2 * self.variance)


def runs_of(frame: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return a number for each frame, the same for consecutive ones, (frames,)."""
    return np.cumsum(np.diff(frame, prepend=frame[0] - 1) > 1).astype(np.int64)


def measured_delay(loop: Recording) -> tuple[LoopDelay, LoopDelay]:
    """Return delay and gain as measured and as used, the latter for whole frames if close to them.

    Raises
    ------
    InputError
        When the loop is not closed, too short, or the gain cannot be measured.
    """
    if not loop.is_closed:
        raise InputError(
            "recording: expected a closed loop, got an open one (loop = open, is_closed = False)"
        )
    if not np.ptp(loop.commands, axis=0).any():
        raise InputError("commands: expected those of a closed loop, got constant ones")
    fits = ModalFits(*of_modes(loop)) if loop.cells is None else DelayFits(*_of_fit(loop))
    fit = used = fits.best() if loop.delay_frames is None else fits.of(loop.delay_frames)
    nearest = float(round(fit.delay_frames))
    if loop.delay_frames is None and abs(fit.delay_frames - nearest) < _WHOLE_FRAMES:
        used = fits.of(nearest)
    if not min(GAINS) < used.gain < max(GAINS):
        raise InputError(
            f"centroid gain: cannot be known from this recording ({used.gain:.2g}, a limit of the search); "
            "keep the integrator, and record more frames, or check that slopes, commands and matrix are of "
            "one loop"
        )
    return fit, used.for_control()


def with_axes_of(loop: Recording, delay: LoopDelay) -> LoopDelay:
    """Return delay and centroid gain with the gain of x relative to y; see `with_axes`."""
    return with_axes(delay, *_of_fit(loop))


def _of_fit(loop: Recording) -> tuple[Floats, Floats, NDArray[np.int64], SlopeTurbulence, float]:
    """Return what delay and gain are fitted to: slopes, those of the commands, runs, geometry and rate.

    Raises
    ------
    InputError
        When no frame has most of the slopes.
    """
    site, measured = loop.site, np.isfinite(loop.slopes)
    part = measured.mean(axis=0).reshape(2, -1).min(axis=0)
    kept = np.flatnonzero((part > 0) & (part >= _LEAST_MEASURED * part.max()))
    columns = np.concatenate([kept, kept + len(loop.cells)])
    rows = measured[:, columns].mean(axis=1) >= _LEAST_MEASURED if len(kept) else np.zeros(1, np.bool_)
    if not rows.any():
        raise InputError("recording: expected frames with most slopes measured, got none")
    slopes = np.nan_to_num(loop.slopes[rows][:, columns])
    mirror = loop.commands[rows] @ loop.interaction_matrix[columns].T
    site = replace(site, positions_m=site.positions_m[kept])
    return *_filled(loop.frame[rows], slopes, mirror), site, loop.frame_rate_hz


def of_modes(loop: Recording) -> tuple[Floats, Floats, NDArray[np.int64]]:
    """Return what delay, gain and law of a recording in modes are fitted to."""
    rows = np.isfinite(loop.slopes).all(axis=1)
    return _filled(loop.frame[rows], loop.slopes[rows], loop.commands[rows] @ loop.interaction_matrix.T)


def _filled(
    frame: NDArray[np.int64], slopes: Floats, mirror: Floats
) -> tuple[Floats, Floats, NDArray[np.int64]]:
    """Return slopes and those of the mirror, interpolated in short gaps, and runs without a gap.

    Where many frames are missing, gaps remain.
    """
    steps = np.diff(frame)
    short = np.flatnonzero((steps > 1) & (steps <= _SHORT_GAP + 1))
    missing = [number for row in short for number in range(frame[row] + 1, frame[row + 1])]
    if not missing or len(missing) > _MOST_FILLED * len(frame):
        return slopes, mirror, runs_of(frame)
    whole = np.union1d(frame, missing)
    filled = [
        np.array([np.interp(whole, frame, column) for column in values.T]).T for values in (slopes, mirror)
    ]
    return filled[0], filled[1], runs_of(whole)


def known_delay(loop: Recording) -> tuple[LoopDelay, LoopDelay, str]:
    """Return delay and gain as measured and as used, and why they could not be measured, if so.

    Then the delay is the stated one, or 2 frames, and the gain 1; the latter also for estimators with a
    prior, whose slopes are not in proportion to the displacement.
    """
    assumed = LoopDelay(loop.delay_frames or 2.0, math.nan, 1.0, math.nan)
    if loop.prior_std is not None:
        return assumed, assumed, "recording: the estimator had a prior"
    try:
        return *measured_delay(loop), ""
    except InputError as error:
        return assumed, assumed, str(error)


def freed_of_prior(loop: Recording, *, is_predicted: bool) -> Recording:
    """Return a loop without the estimator's prior, which has drawn slopes towards the expected ones.

    Parameters
    ----------
    loop : Recording
        With standard errors, the delay, and `prior_std` where there was a prior.
    is_predicted : bool
        Whether slopes were expected that the latest command takes away; else 0.
    """
    expected, delay = np.zeros_like(loop.slopes), int(loop.delay_frames or 1)
    if is_predicted:
        mirror = loop.commands @ loop.interaction_matrix.T
        expected[delay:] = mirror[:-delay] - mirror[delay - 1 : -1]
    slopes, variance, _ = without_prior(loop.slopes, loop.standard_errors, expected, loop.prior_std)
    slopes = np.where(np.isfinite(variance), slopes, np.nan)
    return replace(loop, slopes=slopes, standard_errors=np.sqrt(variance))


def open_loop_of(loop: Recording, delay: LoopDelay) -> OpenLoop:
    """Return open-loop slopes, with the noise from their spectra if it is not stated.

    Raises
    ------
    InputError
        When fewer than 200 frames have known commands, or are without a gap where many are lost.
    """
    mirror, usable = _held(loop, delay)
    usable &= np.isfinite(loop.slopes).any(axis=1)
    rows = np.flatnonzero(usable)
    if len(rows) and np.ptp(loop.frame[rows]) + 1 > (1 + _MOST_LOST) * len(rows):
        runs = runs_of(loop.frame[rows])
        rows = rows[runs == np.bincount(runs).argmax()]
    if len(rows) < FEWEST_FRAMES:
        raise InputError(f"{len(rows)} frames with known commands, expected {FEWEST_FRAMES}")
    frame = loop.frame[rows] - loop.frame[rows[0]]
    gains = delay.gain if loop.cells is None else delay.gains(len(loop.cells))
    grid = np.full((2, int(frame[-1]) + 1, loop.slopes.shape[1]), np.nan)
    grid[:, frame] = loop.slopes[rows] / gains
    grid[1, frame] -= mirror[rows]
    with np.errstate(invalid="ignore"):
        grid -= np.nansum(grid, axis=1, keepdims=True) / np.isfinite(grid).sum(axis=1, keepdims=True)
    residual, atmosphere = grid
    measured = np.isfinite(atmosphere)
    noise = plateau(atmosphere) if loop.cells is None else noise_of_slopes(atmosphere)
    variance, known = noise.variance, np.isfinite(noise.error)
    if known.any():
        variance = np.where(known, variance, variance[known].mean())
    least = _LEAST_SIGNAL * float(np.nanvar(atmosphere))
    of_frames = usual = np.maximum(variance, least)
    if loop.standard_errors is not None:
        of_frames = np.full(measured.shape, np.inf)
        of_frames[frame] = np.maximum(np.square(loop.standard_errors[rows] / gains), least)
        usual = np.median(of_frames[frame], axis=0)
        measured &= np.isfinite(of_frames)
    of_frames = np.where(measured, of_frames, np.inf)
    trust = measured.astype(np.float64)
    if loop.prior_std is not None:
        trust = np.square(loop.prior_std) / (np.square(loop.prior_std) + of_frames)
    covariance = None
    if loop.covariance_xy is not None and loop.prior_std is None and loop.covariance_xy[rows].any():
        covariance = np.zeros((len(measured), measured.shape[1] // 2))
        covariance[frame] = loop.covariance_xy[rows] / delay.gain**2
        covariance[~measured.reshape(len(measured), 2, -1).all(axis=1)] = 0.0
    telemetry = OpenLoopTelemetry(np.where(measured, atmosphere, 0.0), of_frames, trust, covariance)
    runs = np.repeat(runs_of(frame), np.diff(frame, append=frame[-1] + 1))
    errors = noise.error, noise.shared_error
    return OpenLoop(telemetry, np.where(measured, residual, 0.0), runs, usual, *errors)


def _held(loop: Recording, delay: LoopDelay) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the slopes of the mirror in each frame, and whether they are known."""
    mirror, is_known = np.zeros_like(loop.slopes), np.ones(len(loop.slopes), np.bool_)
    if loop.commands is None or loop.interaction_matrix is None or not loop.is_closed:
        return mirror, is_known
    frames, part = int(delay.delay_frames), delay.delay_frames % 1
    caused = loop.commands @ loop.interaction_matrix.T
    for lag, share in ((frames, 1 - part), (frames + 1, part)):
        if share > 0:
            sent = np.searchsorted(loop.frame, loop.frame - lag)
            mirror += share * caused[sent]
            is_known &= loop.frame[sent] == loop.frame - lag
    return mirror, is_known


R0 = "r0 at 500 nm"
_WIND_ERROR = 0.35  # sub-apertures per second: measured slopes are not quite mean gradients in squares


@dataclass(frozen=True)
class Measured:
    """A quantity measured from telemetry."""

    name: str
    unit: str
    value: float = math.nan
    """Measured value; NaN if unknown."""
    error: float = math.nan
    """Standard error; NaN if unknown."""
    remark: str = ""
    """Reason why it is unknown, or assumptions of the value."""
    is_positive: bool = False
    """Whether negative values are impossible."""

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval; with small errors, or where only positive values occur, that of the logarithm."""
        if not self.value > 0 or (self.error > 0.5 * self.value and not self.is_positive):
            return self.value - 1.96 * self.error, self.value + 1.96 * self.error
        factor = math.exp(1.96 * self.error / self.value)
        return self.value / factor, self.value * factor

    def as_values(self) -> dict[str, object]:
        """Return plain values; the remark says why one is NaN."""
        low, high = self.interval
        numbers = {"value": self.value, "error": self.error, "low": low, "high": high}
        return {"name": self.name, "unit": self.unit, **numbers, "remark": self.remark}


@dataclass(frozen=True)
class Wind:
    """Layer of turbulence that the wind carries over the telescope."""

    speed: Measured
    direction: Measured
    """Towards which it moves, from +x (along columns) to +y (along rows)."""
    share: Measured

    @classmethod
    def of(cls, row: Iterable[float], speed_unit: str = "m/s") -> Self:
        """Return the layer of values and errors, as `row` gives them."""
        speed, speed_error, direction, direction_error, share, share_error = map(float, row)
        return cls(
            Measured("speed", speed_unit, speed, speed_error),
            Measured("direction", "degrees", direction, direction_error, "towards, from +x to +y"),
            Measured("share", "", share, share_error),
        )

    def row(self) -> list[float]:
        """Return speed, direction and share, each with its standard error."""
        values = self.speed, self.direction, self.share
        return [number for value in values for number in (value.value, value.error)]


def winds_of(identified: Identified) -> list[Wind]:
    """Return the layers of identified turbulence, the strongest first."""
    turbulence, errors = identified.turbulence, wind_errors(identified)
    layers = []
    for number in np.argsort(-turbulence.fraction):
        x, y = turbulence.wind_m_per_s[number]
        speed = max(math.hypot(x, y), 1e-9)
        along = float(np.hypot(*(errors[number] * (x, y)))) / speed
        across = float(np.hypot(*(errors[number] * (y, x)))) / speed
        direction = math.degrees(math.atan2(y, x)) % 360, math.degrees(across / speed)
        share = turbulence.fraction[number], identified.fraction_error[number]
        layers.append(Wind.of((speed, along, *direction, *share), f"{turbulence.length_unit}/s"))
    return layers


def wind_errors(identified: Identified) -> Floats:
    """Return standard errors (layers, 2) of winds, m/s, with those of the model."""
    return np.hypot(identified.wind_error_m_per_s, _WIND_ERROR * identified.turbulence.subaperture_m)


def outer_scale_and_r0(strength: TurbulenceStrength, known_scale_m: float | None = None) -> list[Measured]:
    """Return the outer scale, where it is known with this value, and r0."""
    remark = f"{OUTER_SCALE_M:g} m within a factor of two was expected" if known_scale_m is None else "given"
    name, unit = R0, "m"
    if not math.isfinite(strength.r0_m):
        outer = Measured("outer scale", "m", remark="unknown without r0")
        return [outer, Measured(name, unit, remark="the slopes vary no more than their noise")]
    outer = Measured("outer scale", "m", strength.outer_scale_m, strength.outer_scale_error_m, remark, True)
    return [outer, Measured(name, unit, strength.r0_m, strength.r0_error_m, is_positive=True)]
