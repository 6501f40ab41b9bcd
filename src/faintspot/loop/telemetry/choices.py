"""Residual wavefront of other controllers, by replay of the slopes of a recorded loop.

Recorded slopes hold more than turbulence and white noise: unequal centroid gains, speckles. These grow with
the residual wavefront, so a filter that leaves less has less of them. Its residual is that in the identified
turbulence, with the noise of small displacements.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.checks import not_none
from faintspot.base.errors import InputError
from faintspot.base.statistics import mean_by_blocks
from faintspot.loop.control.base import SETTLE_FRAMES, OpenLoopTelemetry
from faintspot.loop.control.flattening import residual_phase
from faintspot.loop.control.identification.layers import Identified
from faintspot.loop.control.identification.learning import GAINS, learn_controller
from faintspot.loop.control.identification.loop_delay import LoopDelay
from faintspot.loop.control.identification.open_loop import Measured, OpenLoop
from faintspot.loop.control.identification.recording import Recording
from faintspot.loop.control.integrator import LoopPlant
from faintspot.loop.control.kalman.predictor import steady_covariance
from faintspot.loop.control.reconstructor import make_reconstructor
from faintspot.loop.slope_covariance import ARCSEC, SlopeTurbulence

BEST, AS_RUN = "integrator, best gain", "as it ran"
FILTER = "predictive Kalman filter"
FEWEST_FRAMES = 600
_MOST_SLOPES = 500  # beyond, the filter takes too long to learn
_LEAK = 0.01
_BLOCKS = 12
_MODEL_ERROR = 0.3  # of the difference between a filter's replay and its model: 16 nm of 60 in our simulation
_WIDE = 1.96  # standard errors on each side in an interval
_LEAST_COMPARED = 0.25  # of the frames: those with the largest shares of measured slopes
_FITTING, _FITTING_ERROR = 0.28, 0.04  # rad^2 at (sub-aperture / r0)^(5/3): continuous mirrors
_ALIASING = 0.08  # rad^2, likewise: what the sensor mistakes for larger scales (Rigaut et al. 1998)
_R0_WAVELENGTH_NM = 500.0


@dataclass(frozen=True)
class ControlChoice:
    """Controller and its replayed residual in the second half of the recording."""

    name: str
    residual: Measured
    """Rms of the residual wavefront within the mirror's reach."""
    less: Measured
    """Root of the variance saved relative to the loop as it ran; negative if it is larger."""
    total: Measured
    """Strehl ratio, including the fitting error."""
    strehl: Measured
    gain: float = math.nan
    """Gain of an integrator, on slopes as measured."""

    @property
    def gain_text(self) -> str:
        """The gain in words; empty for a filter."""
        return f"{self.gain:.2f}" if math.isfinite(self.gain) else ""

    def as_values(self) -> dict[str, Any]:
        """Return plain values."""
        names = ("residual", "less", "total", "strehl")
        gain = {"gain": self.gain} if math.isfinite(self.gain) else {}
        return {"name": self.name, **gain, **{name: getattr(self, name).as_values() for name in names}}


def compared_choices(
    loop: Recording,
    open_loop: OpenLoop,
    delay: LoopDelay,
    site: SlopeTurbulence,
    r0: Measured,
    identified: Identified | None,
) -> list[ControlChoice]:
    """Replay integrators of several gains and a predictive filter that learns from the first half.

    Where the turbulence is identified, the filter's residual is that in this turbulence, and the difference
    from the replay is an error.

    Raises
    ------
    InputError
        When there are too few frames, or the mirror cannot be controlled by the slopes.
    """
    frames = len(open_loop.telemetry)
    interaction_matrix = not_none(loop.interaction_matrix)
    if frames < FEWEST_FRAMES:
        raise InputError(f"{frames} frames, expected {FEWEST_FRAMES} for a replay")
    reconstructor = make_reconstructor(interaction_matrix)
    plant = LoopPlant(interaction_matrix, reconstructor, max(1, round(delay.delay_frames)), _LEAK)
    phase = residual_phase(reconstructor.clean, interaction_matrix, loop.cells)
    gain_error = float(np.nan_to_num(delay.gain_error)) / delay.gain
    views = [_View.of(slopes, phase) for slopes in (open_loop, open_loop.scaled(1 + gain_error))]
    relative = float(np.nanmean(open_loop.variance_error)) / math.sqrt(len(reconstructor.modes.T))
    scale = _Scale.of(loop, r0, delay, relative)

    def integrators(gains: Sequence[float]) -> list[list[Floats]]:
        of_views = [view.compared(plant.replayed_integrators(gains, view.replayed, phase)) for view in views]
        return [list(values) for values in zip(*of_views, strict=True)]

    ran = None
    if loop.is_closed and loop.commands is not None:
        ran = [view.ran for view in views]
    noise = [view.noise for view in views]
    compare = partial(_choice, ran=ran, noise=noise, scale=scale)
    choices = [] if ran is None else [compare(AS_RUN, ran)]
    first = open_loop.telemetry.part(0, frames // 2)
    if len(open_loop.variance) <= _MOST_SLOPES:
        known = plant, first, site, loop.frame_rate_hz
        learnt = learn_controller(*known)
        choices.append(compare(BEST, *integrators([learnt.plain_gain]), gain=learnt.plain_gain))
        expected = math.nan
        if identified is not None:
            expected = _expected_left(identified, plant, delay.gain**2 * open_loop.variance, phase)
        left = [view.compared(learnt.replayed(plant, view.replayed, phase)) for view in views]
        choices.append(compare(FILTER, left, expected=expected))
    else:
        best, _ = plant.best_gain(GAINS, first, phase)
        choices.append(compare(BEST, *integrators([best]), gain=best))
    uncorrected = float(np.square(views[0].replayed.open_loop_px @ phase.T).sum(axis=1).mean())
    for gain, values in zip(GAINS[1::2], integrators(GAINS[1::2]), strict=True):
        if values[0].max() < np.inf and values[0].mean() < uncorrected:  # else it is not stable
            choices.append(compare("integrator", values, gain=gain))
    return [replace(choice, gain=choice.gain / delay.gain) for choice in choices]


def _expected_left(identified: Identified, plant: LoopPlant, variance: Floats, phase: Floats) -> float:
    """Return the phase variance that the predictive filter leaves in the turbulence that was identified."""
    model = identified.slope_model()
    after = model.spread(steady_covariance(model, variance), plant.delay_frames - 1)
    return float(np.einsum("pi,ij,pj->", phase, model.observation @ after @ model.observation.T, phase))


@dataclass(frozen=True, eq=False)
class _View:
    """Second half of the recording with one centroid gain: as found, or a standard error away from it."""

    replayed: OpenLoopTelemetry
    """Second half, and the frames before it in which controllers settle."""
    scored: NDArray[np.int64]
    """Frames of these that are compared."""
    share: Floats
    """Share of the slopes that were measured in them."""
    ran: Floats
    """Squared phase of the loop as it ran in the frames that are compared."""
    noise: float
    """Phase variance of the noise."""

    @classmethod
    def of(cls, open_loop: OpenLoop, phase: Floats) -> _View:
        half = len(open_loop.telemetry) // 2
        replayed = open_loop.telemetry.part(half - SETTLE_FRAMES, None)
        share = replayed.trust.mean(axis=1)
        least = np.quantile(share[SETTLE_FRAMES:], 1 - _LEAST_COMPARED)
        scored = SETTLE_FRAMES + np.flatnonzero(share[SETTLE_FRAMES:] >= max(float(least), 1e-9))
        # Slopes never measured count as the mean of the others, as in `compared`.
        known = np.isfinite(open_loop.variance)
        variance = np.where(known, open_loop.variance, open_loop.variance[known].mean())
        noise = float(variance @ np.square(phase).sum(axis=0))
        view = cls(replayed, scored, share[scored], np.zeros(0), noise)
        ran = np.square(open_loop.residual[half - SETTLE_FRAMES :] @ phase.T).sum(axis=1)
        return replace(view, ran=view.compared(ran))

    def compared(self, frames: Floats) -> Floats:
        """Return the squared phase in the frames that are compared, for slopes that are all measured."""
        return np.asarray(frames[..., self.scored] / self.share)


@dataclass(frozen=True)
class _Scale:
    """Conversion of phase variances to wavefronts and Strehl ratios."""

    unit: str
    factor: float
    fitting_nm2: float
    fitting_error_nm2: float
    wavelength_nm: float
    gain_error: float
    """Relative error of variances due to that of the centroid gain."""
    noise_error: float
    """Relative error of the noise's phase variance."""

    @classmethod
    def of(cls, loop: Recording, r0: Measured, delay: LoopDelay, noise_error: float) -> _Scale:
        gain_error = 2 * float(np.nan_to_num(delay.gain_error))
        if loop.subaperture_m is None or loop.pixel_scale_arcsec is None:
            unit = f"{loop.slope_unit or 'slope unit'} x sub-aperture"
            return cls(unit, loop.unit, math.nan, math.nan, math.nan, gain_error, noise_error)
        factor = loop.pixel_scale_arcsec * ARCSEC * loop.subaperture_m * 1e9
        unseen = 1e18 * unseen_m2(loop.subaperture_m, r0.value)
        of_fitting = _FITTING_ERROR / (_FITTING + _ALIASING)
        error = unseen * math.hypot(of_fitting, 5 / 3 * r0.error / r0.value)
        wavelength_nm = loop.science_wavelength_m * 1e9
        return cls("nm", factor, unseen, error, wavelength_nm, gain_error, noise_error)


def unseen_m2(subaperture_m: float, r0_m: float) -> float:
    """Return the variance of the wavefront that slopes do not show: fitting and aliasing, m^2."""
    radians = (_FITTING + _ALIASING) * math.pow(subaperture_m / r0_m, 5 / 3)
    return radians * (1e-9 * _R0_WAVELENGTH_NM / (2 * math.pi)) ** 2


def _choice(
    name: str,
    squares: list[Floats],
    ran: list[Floats] | None,
    noise: list[float],
    scale: _Scale,
    gain: float = math.nan,
    expected: float = math.nan,
) -> ControlChoice:
    """Return a choice from its squared phase in each view, or from the expected one."""
    unit = scale.factor**2
    without = [values - level for values, level in zip(squares, noise, strict=True)]
    square, error = _mean_of_views(without, unit)
    error = math.hypot(error, unit * noise[0] * scale.noise_error, scale.gain_error * square)
    less = Measured("less than as it ran", scale.unit, remark="the loop was open")
    corrected = 0.0 if math.isnan(expected) else square - unit * expected
    square, error = square - corrected, math.hypot(error, _MODEL_ERROR * corrected)
    if ran is not None:
        saved, error_of_saved = _saved(ran, squares, noise)
        level = unit * float(ran[0].mean() - noise[0])
        saved_error = math.hypot(level * error_of_saved, _MODEL_ERROR * corrected)
        less = _signed_root(less.name, scale.unit, level * saved + corrected, saved_error)
    total = square + scale.fitting_nm2
    total_error = math.hypot(error, scale.fitting_error_nm2)
    wave = (2 * math.pi / scale.wavelength_nm) ** 2
    strehl = math.exp(-wave * total) if math.isfinite(total) else math.nan
    remark = "" if math.isfinite(total) else "r0, pixel_scale_arcsec or subaperture_m is unknown"
    return ControlChoice(
        name,
        _root("residual", scale.unit, square, error),
        less,
        _root("with fitting and aliasing", scale.unit, total, total_error, remark),
        Measured("Strehl ratio", "", min(strehl, 1.0), strehl * wave * total_error, remark),
        gain,
    )


def _saved(ran: list[Floats], squares: list[Floats], noise: list[float]) -> tuple[float, float]:
    """Return the part of the loop's variance that another control saves in the same frames, and its error.

    As a part, it does not depend on the scale of the wavefront, which differs between the views.
    """
    parts = [
        (before - after) / max(float(before.mean()) - part, 1e-12 * float(before.mean()), 1e-300)
        for before, after, part in zip(ran, squares, noise, strict=True)
    ]
    return _mean_of_views(parts, 1.0)


def _mean_of_views(values: list[Floats], unit: float) -> tuple[float, float]:
    """Return the mean for the centroid gain as found, and its error with that of the gain."""
    block = max(1, len(values[0]) // _BLOCKS)
    means = [mean_by_blocks(view, block) for view in values]
    estimates = [mean.value for mean in means]
    error = math.hypot(means[0].standard_error, max(estimates) - min(estimates))
    return unit * estimates[0], unit * error


def _root(name: str, unit: str, square: float, error: float, remark: str = "") -> Measured:
    """Return the root of a variance, with its sign."""
    if not math.isfinite(square):
        return Measured(name, unit, remark=remark)
    root = math.copysign(math.sqrt(abs(square)), square)
    if name == "residual" and square < error:
        return Measured(name, unit, remark=f"less than {math.sqrt(max(square, 0.0) + 2 * error):.3g}")
    return Measured(name, unit, root, error / max(2 * abs(root), math.sqrt(error), 1e-12), remark)


def _signed_root(name: str, unit: str, square: float, error: float) -> Measured:
    """Return the signed root of a difference of variances; its interval has 0 if the difference's has."""
    if not (math.isfinite(square) and math.isfinite(error)):
        return Measured(name, unit)
    low, root, high = (
        math.copysign(math.sqrt(abs(value)), value)
        for value in (square - _WIDE * error, square, square + _WIDE * error)
    )
    return Measured(name, unit, root, max(root - low, high - root) / _WIDE)


def advice(choices: list[ControlChoice]) -> str:
    """Return one sentence that says which control to use."""
    others = [choice for choice in choices if choice.name != AS_RUN]
    if not others:
        return ""
    ran = any(choice.name == AS_RUN for choice in choices)
    if not ran:
        return (
            f"Use {_recommended(min(others, key=_residual))}: it leaves least in a replay of the recording."
        )
    best = max(others, key=lambda choice: np.nan_to_num(choice.less.value, nan=-np.inf))
    low, high = best.less.interval
    if not low > 0:
        return "Keep the control as it is: no other choice leaves significantly less of the wavefront."
    amount = f"{best.less.value:.3g} {best.less.unit} ({low:.3g} to {high:.3g})"
    return f"Use {_recommended(best)}: it leaves {amount} less than the loop as it ran."


def _residual(choice: ControlChoice) -> float:
    return choice.residual.value if math.isfinite(choice.residual.value) else math.inf


def _recommended(choice: ControlChoice) -> str:
    if choice.gain_text:
        return f"an integrator with a gain of {choice.gain_text}"
    return "the predictive Kalman filter"
