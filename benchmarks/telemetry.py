"""How well a recorded loop tells delay, noise, turbulence and what other control would leave.

Loops near the diffraction limit are simulated with one gain and reported as `faintspot telemetry` does. Their
delay is not given. The same turbulence with another gain and with the predictive filter shows what these
really leave.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.measuring import Row, Table
from faintspot.advice.loop_choices import AS_RUN, FILTER, Choice
from faintspot.advice.loop_report import LoopReport, report_of_loop
from faintspot.advice.measured import Measured
from faintspot.advice.recorded_loop import RecordedLoop
from faintspot.ao_loop import LoopConfiguration, LoopRecord, Method, load_loop, simulate_loop
from faintspot.ao_loop.configuration import ARCSEC
from faintspot.control.learning import KALMAN
from faintspot.pipeline.settings import Settings

FRAMES, REALISATIONS = 3000, 5
_GAINS = {20.0: (0.17, 0.1), 200.0: (0.4, 0.25)}
"""Gain of the recorded loop and of the other one, by photons per sub-aperture and frame."""


def recording(record: LoopRecord) -> RecordedLoop:
    """Return a simulated loop as a recording: the command of each row follows from its slopes."""
    later, first = record.delay_frames, record.settle_frames
    slopes = record.slopes_px.astype(np.float64) / record.centroid_gain[0]
    slopes[~np.tile(record.valid, 2)] = np.nan
    return RecordedLoop(
        "simulated",
        slopes[first:-later],
        np.arange(first, record.frames - later),
        record.frame_rate_hz,
        "px",
        record.cells,
        record.commands[first + later :].astype(np.float64),
        record.interaction_matrix,
        record.subaperture_m,
        record.pixel_scale_rad / ARCSEC,
    )


def run() -> list[Table]:
    """Report loops at each flux."""
    tables = []
    for photons in _GAINS:
        rows = [_row(photons, realisation) for realisation in range(REALISATIONS)]
        title = f"A recorded loop, {photons:g} photons: value / truth, and errors"
        note = f"{FRAMES} frames, diffraction_limit, slopes by window; residuals with the fitting error"
        tables.append(Table(f"telemetry-{photons:g}", title, rows, [note]))
    return tables


def _row(photons: float, realisation: int) -> Row:
    configuration = load_loop("diffraction_limit").replace("camera", photons_per_subaperture=photons)
    configuration = configuration.replace("run", frames=FRAMES, settle_frames=100)
    gain, other = _GAINS[photons]
    own, second = (Method("window", Settings("window"), gain=each) for each in (gain, other))
    first, *rest = (
        simulate_loop(configuration, [method], realisation=realisation)
        for method in (own, second, replace(own, control=KALMAN))
    )
    report = report_of_loop(recording(first))
    error = first.standard_error_px[first.scored] / first.centroid_gain[0]
    noise = float(np.sqrt(np.square(error[np.isfinite(error)]).mean()))
    r0 = float((first.r0_m ** (-5 / 3)).mean() ** (-3 / 5))
    curve = [each for each in report.choices if each.name == "integrator"]
    nearest = min(curve, key=lambda each: abs(each.gain - other))
    chosen = _named(report, AS_RUN), nearest, _named(report, FILTER)
    truth = [float(np.sqrt(np.square(each.residual_nm[FRAMES // 2 :]).mean())) for each in (first, *rest)]
    values = {
        "delay": _value(report, "loop", "delay").value,
        "delay error": _value(report, "loop", "delay").error,
        "noise": _value(report, "noise", "noise of a slope").value / noise,
        "r0": _value(report, "turbulence", "r0 at 500 nm").value / r0,
        "r0 error": _value(report, "turbulence", "r0 at 500 nm").error / r0,
        "largest wind error, m/s": _wind_error(report, configuration),
        "as run": chosen[0].total.value / truth[0],
        "other gain": chosen[1].total.value / truth[1],
        "filter": chosen[2].total.value / truth[2],
    }
    return Row(f"realisation {realisation}", values)


def _named(report: LoopReport, name: str) -> Choice:
    return next(each for each in report.choices if each.name == name)


def _value(report: LoopReport, part: str, name: str) -> Measured:
    return next(each for each in report.parts[part].known if each.name == name)


def _wind_error(report: LoopReport, configuration: LoopConfiguration) -> float:
    """Return the largest distance of a layer's true wind from the nearest one found."""
    assert report.turbulence is not None
    atmosphere = configuration.atmosphere
    angle = np.deg2rad(atmosphere.wind_direction_deg)
    true = np.array(atmosphere.wind_speed_m_per_s) * np.array([np.cos(angle), np.sin(angle)])
    apart = np.hypot(*(true[:, :, None] - report.turbulence.turbulence.wind_m_per_s.T[:, None]))
    return float(apart.min(axis=1).max())
