"""Report of a recorded loop: noise, turbulence, vibrations and control, each with its error."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from faintspot.base.arrays import Floats
from faintspot.base.checks import number_between
from faintspot.base.errors import InputError
from faintspot.base.report.texts import Texts
from faintspot.loop.control.identification.layers import Identification, Identified
from faintspot.loop.control.identification.loop_delay import FEWEST_SUBAPERTURES, LoopDelay
from faintspot.loop.control.identification.modal_delay import modes_of
from faintspot.loop.control.identification.open_loop import (
    R0,
    Measured,
    OpenLoop,
    known_delay,
    measured_delay,
    open_loop_of,
    with_axes_of,
)
from faintspot.loop.control.identification.preparation import Prepared, gains_of_pieces, order_doubt, prepared
from faintspot.loop.control.identification.recording import Recording
from faintspot.loop.slope_covariance import ARCSEC
from faintspot.loop.telemetry.spectra import (
    ModalSpectra,
    measured_strength,
    measured_winds,
    modal_spectra,
    recorded_discrepancy,
)
from faintspot.slopes.sensor.pupil import subapertures_across

if TYPE_CHECKING:
    from faintspot.loop.control.identification.learnt_loop import ObservedLoop
    from faintspot.loop.telemetry.choices import ControlChoice
    from faintspot.loop.telemetry.scintillation import Scintillation


_TEXT = Texts("faintspot.loop.telemetry")
_PARTS = ("frames", "loop", "noise", "scintillation", "turbulence", "vibrations", "spectra", "choices")
_OF_TURBULENCE = _PARTS[4:]
_TIMES_AT_LIMIT = 3  # that a largest value occurs, to be taken for a limit
_MOST_UNMEASURED = 0.2  # of the slopes; large ones are missed most, so that the others vary too little
_LEAST_GAIN = 0.5  # of the usual one, with which commands follow slopes in a piece
_SURE_ERRORS, _CHANGED = 3.0, 0.5  # standard errors, and frames, by which delays of halves differ
_INDISTINCT = 0.5  # relative error of the noise, from which it may be turbulence


@dataclass
class Part:
    """A part of a report."""

    title: str
    values: list[Measured] = field(default_factory=list)
    missing: str = ""
    """Reason for missing values."""


@dataclass
class LoopReport:
    """Report of a recorded loop."""

    loop: Recording
    parts: dict[str, Part]
    noise_px: Floats | None = None
    """(2 n,): standard deviation of each slope's noise, in the unit of the slopes."""
    noise_error_px: Floats | None = None
    scintillation: Scintillation | None = None
    turbulence: Identified | None = None
    spectra: ModalSpectra | None = None
    choices: list[ControlChoice] = field(default_factory=list)
    delay: LoopDelay | None = None
    """Delay and centroid gain that were measured and are used."""
    observed: ObservedLoop | None = None
    """From which a controller can be learnt; None if delay or turbulence are unknown."""
    doubts: list[str] = field(default_factory=list)
    """Reasons not to trust the numbers; then there is no advice."""

    def lack(self, reason: str, names: Sequence[str] = _OF_TURBULENCE) -> None:
        """State why parts have no values, unless a reason is stated already."""
        for name in names:
            self.parts[name].missing = self.parts[name].missing or reason

    @property
    def advice(self) -> str:
        """Recommendation in one sentence; empty if no control was compared, or the data are doubtful."""
        if not self.choices or self.doubts:
            return ""
        from faintspot.loop.telemetry.choices import advice  # with all filters

        return advice(self.choices)

    def as_values(self) -> dict[str, Any]:
        """Return the report as plain values, for JSON; null is not known."""
        values: dict[str, Any] = {
            name: {
                "title": part.title,
                "known": [value.as_values() for value in part.values],
                "missing": part.missing,
            }
            for name, part in self.parts.items()
        }
        if self.noise_px is not None and self.noise_error_px is not None:
            values["noise"]["of_slopes"] = _rounded(self.noise_px)
            values["noise"]["of_slopes_error"] = _rounded(self.noise_error_px)
            if not np.isfinite(self.noise_px).all():
                values["noise"]["of_slopes_unknown"] = "null: not measured in five consecutive frames"
        if self.scintillation is not None:
            values["scintillation"]["of_subapertures"] = _rounded(self.scintillation.index)
            values["scintillation"]["of_subapertures_error"] = _rounded(self.scintillation.index_error)
        values["choices"]["compared"] = [choice.as_values() for choice in self.choices]
        return {
            "recording": self.loop.name,
            "slope_unit": self.loop.slope_unit,
            "remarks": list(self.loop.remarks),
            "doubts": self.doubts,
            "advice": self.advice,
            **values,
        }


def report_of_loop(
    loop: Recording,
    progress: Callable[[str], None] = lambda _: None,
    *,
    compare: bool = True,
    fade_level: float = 0.5,
) -> LoopReport:
    """Analyse a recorded loop.

    Parameters
    ----------
    loop : Recording
    progress : callable
        Called with the name of each step.
    compare : bool
        Whether other choices of control are replayed, and parts of the recording compared.
    fade_level : float
        Flux of the aperture below which its light fades, relative to the mean.

    Raises
    ------
    InputError
        When the slopes do not vary, commands and slopes are not of one loop, or the level is not a share.
    """
    ready, report = _begun(loop)
    if loop.flux is not None:
        progress("scintillation")
        _scintillation(report, number_between("fade_level", fade_level, 0.0, 1.0, low_open=True))
    progress("delay")
    delay = _loop(report, in_parts=compare)
    progress("noise")
    open_loop = _noise(report, delay)
    if open_loop is not None:
        progress("turbulence")
        identification = _turbulence(report, open_loop, delay)
        if report.delay is not None and identification is not None:
            from faintspot.loop.control.identification.learnt_loop import ObservedLoop

            report.observed = ObservedLoop(ready, report.delay, open_loop, identification)
        if compare:
            progress("other choices")
            _choices(report, open_loop, delay)
    return report


def noise_of_loop(loop: Recording) -> LoopReport:
    """Return a report with the noise alone; errors are those of `report_of_loop`."""
    _, report = _begun(loop)
    _noise(report, _loop(report, in_parts=True))
    return report


def _begun(loop: Recording) -> tuple[Prepared, LoopReport]:
    """Return the recording in one convention, and a report on its frames."""
    ready = prepared(replace(loop, remarks=()))  # a controller that is learnt describes itself, not the files
    names = [name for name in _PARTS if name != "scintillation" or loop.flux is not None]
    parts = {name: Part(_TEXT[f"{name}.title"]) for name in names}
    remarks = (*loop.remarks, *ready.recording.remarks)
    report = LoopReport(replace(ready.recording, remarks=remarks), parts)
    report.doubts += filter(None, [order_doubt(ready.recording)])
    _frames(report)
    return ready, report


def _frames(report: LoopReport) -> None:
    loop, part = report.loop, report.parts["frames"]
    lost = np.diff(loop.frame) - 1
    span = (loop.frame[-1] - loop.frame[0] + 1) / loop.frame_rate_hz
    part.values = [
        Measured("frames", "", len(loop.frame), 0.0),
        Measured("duration", "s", float(span), 0.0),
        Measured("lost frames", "", float(lost.sum()), 0.0, f"in {np.count_nonzero(lost)} gaps"),
        Measured("longest gap", "frames", float(lost.max(initial=0)), 0.0),
        Measured("slopes not measured", "%", round(100 * float(np.isnan(loop.slopes).mean()), 2), 0.0),
    ]
    missing = 1 - np.isfinite(loop.slopes).any(axis=1).sum() / (loop.frame[-1] - loop.frame[0] + 1)
    if missing > _MOST_UNMEASURED:
        report.doubts.append(_TEXT("doubts.missing", share=missing))


def _scintillation(report: LoopReport, fade_level: float) -> None:
    from faintspot.loop.telemetry.scintillation import measure_scintillation  # few recordings hold fluxes

    loop, part = report.loop, report.parts["scintillation"]
    try:
        found = measure_scintillation(loop.flux, loop.frame_rate_hz, fade_level, loop.frame)
    except InputError as error:
        part.missing = f"{error}."
        return
    report.scintillation, part.values = found, found.values


def _loop(report: LoopReport, *, in_parts: bool) -> LoopDelay:
    """Return delay and gain; without commands those of an open loop."""
    loop, part = report.loop, report.parts["loop"]
    is_still = loop.commands is None or not np.ptp(loop.commands, axis=0).any()
    if not loop.is_closed or (is_still and loop.commands is not None):
        part.missing = "The loop was open: it has no delay and no gain to measure."
        return LoopDelay(1.0, 0.0, 1.0, loop.gain_error or 0.0)
    part.values.append(_saturated(loop))
    if loop.commands is None or loop.interaction_matrix is None:
        absent = "commands" if loop.commands is None else "an interaction or control matrix"
        why = f"The recording has no {absent}: its open-loop slopes are unknown."
        report.lack(why, ("loop", *_OF_TURBULENCE))
        return LoopDelay(1.0, 0.0, 1.0, 0.0)
    values, delay = _delay(report, in_parts)
    part.values = [*values, *part.values]
    return delay


def _delay(report: LoopReport, in_parts: bool) -> tuple[list[Measured], LoopDelay]:
    """Return delay and gain as reported and as used."""
    loop = report.loop
    names, assumed = (("delay", "frames"), ("centroid gain", "")), loop.delay_frames
    in_modes, fitted = loop.cells is None or len(loop.cells) < FEWEST_SUBAPERTURES, loop
    if in_modes:
        with suppress(InputError):  # the reason is that of the delay, which then is not known either
            fitted = modes_of(loop).recording
    fit, used, unknown = known_delay(fitted)
    if unknown:
        report.doubts.append(_TEXT["doubts.delay"])
        remarks = f"{unknown}; {used.delay_frames:g} is used", f"{unknown}; 1 is used"
        return [Measured(*name, remark=text) for name, text in zip(names, remarks, strict=True)], used
    report.doubts += _changes(fitted) if in_parts else []
    remark = "given" if assumed is not None else f"{used.delay_frames:g} is used" if used is not fit else ""
    if not in_modes:
        used = with_axes_of(loop, used)
        report.delay = replace(used, delay_error=fit.delay_error)
    gain = Measured(*names[1], used.gain, used.gain_error, f"for a delay of {used.delay_frames:.3g} frames")
    if in_modes:
        return [Measured(*names[0], fit.delay_frames, fit.delay_error, remark), gain], used
    of_axes = used.measured_x_to_y, used.x_to_y_error
    axes = Measured("centroid gain of x relative to y", "", *of_axes, f"{used.x_to_y:.3g} is used")
    return [Measured(*names[0], fit.delay_frames, fit.delay_error, remark), gain, axes], used


def _changes(loop: Recording) -> list[str]:
    """Return doubts whether one loop ran during the whole recording: its law, and its delay."""
    gains = gains_of_pieces(loop)
    if len(gains) and not (gains > _LEAST_GAIN).all():
        return [_TEXT("doubts.law", least=float(gains.min()), most=float(gains.max()))]
    middle, halves = len(loop.frame) // 2, list[LoopDelay]()
    for rows in (slice(middle), slice(middle, None)):
        with suppress(InputError):  # of half of the frames it may not be known
            halves.append(measured_delay(replace(loop.part(rows), delay_frames=None))[0])
    if len(halves) < 2:
        return []
    first, second = halves
    error = math.hypot(first.delay_error, second.delay_error)
    if not abs(first.delay_frames - second.delay_frames) > max(_SURE_ERRORS * error, _CHANGED):
        return []
    return [_TEXT("doubts.delays", first=first.delay_frames, second=second.delay_frames)]


def _saturated(loop: Recording) -> Measured:
    """Return how many actuators reached a limit, given or seen as a largest value that occurs repeatedly."""
    name, unit = "actuators that reached a limit", ""
    if loop.commands is None:
        return Measured(name, unit, remark="no commands")
    commands = loop.commands
    if loop.largest_command is not None:
        at_limit = np.abs(commands) >= loop.largest_command * (1 - 1e-6)
        remark = f"largest command {loop.largest_command:g}"
    else:
        low, high = commands.min(axis=0), commands.max(axis=0)
        at_limit = ((commands == high) | (commands == low)) & (high > low)
        at_limit &= at_limit.sum(axis=0) >= 2 * _TIMES_AT_LIMIT
        remark = "largest values that occur repeatedly count as limits"
    number = int(at_limit.any(axis=0).sum())
    most = f"; the worst in {at_limit.mean(axis=0).max():.1%} of the frames" if number else ""
    return Measured(name, unit, float(number), 0.0, f"of {commands.shape[1]}; {remark}{most}")


def _noise(report: LoopReport, delay: LoopDelay) -> OpenLoop | None:
    """Return the open-loop slopes; None if they are unknown."""
    loop, part = report.loop, report.parts["noise"]
    try:
        open_loop = open_loop_of(loop, delay)
    except InputError as error:
        report.lack(f"{error}.", ("noise", *_OF_TURBULENCE))
        return None
    known = np.isfinite(open_loop.variance_error)
    if not known.any() or not open_loop.shared_error < 2 * _INDISTINCT:
        report.doubts.append(_TEXT["doubts.noise"])
    if not known.any():
        part.missing = "No slope was measured in five consecutive frames."
        return open_loop
    gains = delay.gain if loop.cells is None else delay.gains(len(loop.cells))
    report.noise_px = np.where(known, loop.unit * gains * np.sqrt(open_loop.variance), np.nan)
    report.noise_error_px = 0.5 * report.noise_px * open_loop.variance_error
    rms = float(np.sqrt(np.square(report.noise_px[known]).mean()))
    of_each = float(open_loop.variance_error[known].mean()) / math.sqrt(known.sum())
    spread = 0.5 * rms * math.hypot(of_each, open_loop.shared_error)
    if delay.delay_error > 0:  # what the loop has made of noise is left in the slopes of a wrong delay
        earlier = replace(delay, delay_frames=max(delay.delay_frames - delay.delay_error, 1.0))
        other = loop.unit * gains * np.sqrt(open_loop_of(loop, earlier).variance)
        spread = math.hypot(spread, rms - float(np.sqrt(np.square(other[known]).mean())))
    of_spectra = "rms over the slopes, from where their spectra are flat"
    remark = of_spectra if loop.cells is None else "rms over the sub-apertures"
    part.values.append(Measured("noise of a slope", loop.slope_unit, rms, spread, remark))
    scale = loop.pixel_scale_arcsec
    if scale is None or loop.subaperture_m is None:
        part.missing = "Not in nm: pixel_scale_arcsec and subaperture_m are not known."
    else:
        to_nm = scale / loop.unit * ARCSEC * loop.subaperture_m * 1e9
        part.values.append(Measured("tilt over a sub-aperture", "nm", rms * to_nm, spread * to_nm, remark))
    if loop.cells is None:
        report.lack(_TEXT["without_cells"])
    unmeasured = 1 - float(open_loop.telemetry.trust[open_loop.telemetry.trust.any(axis=1)].mean())
    if unmeasured > _MOST_UNMEASURED:
        report.lack(f"{unmeasured:.0%} of the slopes were not measured, more than {_MOST_UNMEASURED:.0%}.")
    return None if report.parts["turbulence"].missing else open_loop


def _turbulence(report: LoopReport, open_loop: OpenLoop, delay: LoopDelay) -> Identification | None:
    """Report the turbulence; return its identification, None if it is unknown."""
    loop = report.loop
    part, site = report.parts["turbulence"], loop.site
    try:
        identification = Identification(open_loop.telemetry, site, loop.frame_rate_hz)
        identified = identification.layers()
    except InputError as error:
        report.lack(str(error), ("turbulence", "vibrations", "spectra"))
        return None
    report.turbulence = identified
    _mirror(report, open_loop, identified)
    report.spectra = modal_spectra(open_loop.telemetry, identified)
    _vibrations(report, identified)
    if len(loop.cells) < FEWEST_SUBAPERTURES:
        part.missing = f"Fewer than {FEWEST_SUBAPERTURES} sub-apertures show neither winds nor r0."
        return identification
    report.parts["noise"].values += recorded_discrepancy(loop, open_loop, identified)
    if loop.subaperture_m is None:
        part.missing = "Without subaperture_m (or diameter_m) neither r0 nor winds are known."
        return identification
    strength = measured_strength(loop, open_loop, delay, replace(identified.turbulence, r0_m=site.r0_m))
    part.values += strength
    if not any(value.name == R0 and math.isfinite(value.value) for value in strength):
        report.doubts.append(_TEXT["doubts.turbulence"])
    if not math.isfinite(strength[0].value) and len(strength) == 1:
        return identification
    part.values += measured_winds(identified, next(value for value in strength if value.name == R0))
    return identification


def _mirror(report: LoopReport, open_loop: OpenLoop, identified: Identified) -> None:
    """Report the change of the mirror since its matrix was measured, of up to 300 slopes."""
    loop, delay = report.loop, report.delay
    if delay is None or loop.interaction_matrix is None:
        return
    from faintspot.loop.control.identification.misregistration import MovableMatrix, misregistration
    from faintspot.loop.control.kalman.predictor import MOST_SLOPES, SlopePredictor

    if len(open_loop.variance) > MOST_SLOPES:
        return

    noise = identified.noise_factor * open_loop.variance
    matrix = MovableMatrix(loop.cells, loop.interaction_matrix)
    found = misregistration(loop, delay, matrix, SlopePredictor(identified.slope_model(), noise))
    report.parts["loop"].values += found.measured()


def _vibrations(report: LoopReport, identified: Identified) -> None:
    loop, part = report.loop, report.parts["vibrations"]
    measured = np.isfinite(loop.slopes).any(axis=0).reshape(2, -1).all(axis=0)
    diameter_m = subapertures_across(loop.cells[measured]) * (loop.subaperture_m or math.nan)
    to_nm = math.sqrt(2) * (loop.pixel_scale_arcsec or math.nan) * ARCSEC * diameter_m / 4 * 1e9
    for line in identified.vibrations:
        rms = line.rms_px, line.rms_error_px
        of_slopes = loop.unit * line.rms_px, loop.unit * line.rms_error_px
        shown = Measured(f"rms of {line.mode}", loop.slope_unit, *of_slopes, "over all slopes")
        if line.mode != "focus" and math.isfinite(to_nm):
            shown = Measured(shown.name, "nm", to_nm * rms[0], to_nm * rms[1])
        frequency = line.frequency_hz, line.frequency_error_hz
        part.values += [Measured(f"frequency of {line.mode}", "Hz", *frequency), shown]
    if not part.values:
        part.missing = "No narrow line stands out of the spectra of tip, tilt and focus."


def _choices(report: LoopReport, open_loop: OpenLoop, delay: LoopDelay) -> None:
    loop, part = report.loop, report.parts["choices"]
    if loop.interaction_matrix is None:
        part.missing = "The recording has no interaction or control matrix: no mirror can be replayed."
        return
    from faintspot.loop.telemetry.choices import compared_choices  # with all filters

    turbulence = report.parts["turbulence"].values
    r0 = next((value for value in turbulence if value.name == R0), Measured(R0, "m"))
    try:
        report.choices = compared_choices(loop, open_loop, delay, loop.site, r0, report.turbulence)
    except InputError as error:
        part.missing = str(error)


def _rounded(values: Floats) -> list[float]:
    return [float(f"{value:.4g}") for value in values]
