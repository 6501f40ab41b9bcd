"""How well a recorded loop tells delay, noise, turbulence and what other control would leave.

Loops near the diffraction limit are simulated and reported as `faintspot telemetry` does. Their delay is not
given. Random loops, half of them with HCIPy's turbulence, show how often intervals hold. Others are run again
in the same turbulence with another gain and with the predictive filter, which shows what these really leave.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.measuring import Row, Table
from benchmarks.recorded_loops import Case, drawn_cases, recorded, winds_of
from faintspot.advice.loop_choices import AS_RUN, FILTER, Choice
from faintspot.advice.loop_report import LoopReport, report_of_loop
from faintspot.advice.measured import Measured
from faintspot.advice.recorded_loop import RecordedLoop
from faintspot.ao_loop import LoopConfiguration, LoopRecord, Method, load_loop, simulate_loop
from faintspot.ao_loop.configuration import ARCSEC
from faintspot.control.learning import KALMAN
from faintspot.pipeline.settings import Settings

FRAMES, REALISATIONS = 3000, (40, 41)
RANDOM_LOOPS, RANDOM_SEED = 14, 7
"""Realisations and a seed on which nothing was chosen."""
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
    """Report random loops, and loops at each flux."""
    tables = [_coverage()]
    for photons in _GAINS:
        rows = [_row(photons, realisation) for realisation in REALISATIONS]
        title = f"A recorded loop, {photons:g} photons: value / truth, and errors"
        note = f"{FRAMES} frames, diffraction_limit, slopes by window; residuals with the fitting error"
        tables.append(Table(f"telemetry-{photons:g}", title, rows, [note]))
    return tables


def _coverage() -> Table:
    """Report random loops: value / truth, and whether the 95 % interval holds."""
    found = [_of_case(case) for case in drawn_cases(RANDOM_LOOPS, RANDOM_SEED)]
    rows = []
    for name in found[0]:
        known = [each[name] for each in found if each[name] is not None]
        ratio, relative, holds = np.array(known, np.float64).T
        values = {
            "mean value / truth": float(ratio.mean()),
            "standard deviation": float(ratio.std(ddof=1)),
            "mean error": float(relative.mean()),
            "intervals that hold": float(holds.mean()),
            "loops": float(len(known)),
        }
        rows.append(Row(name, values))
    title = "Random recorded loops: value / truth, and share of 95 % intervals that hold"
    return Table("telemetry-random", title, rows, ["20 to 300 photons, r0 0.18 to 0.32 m, delay 1 to 3"])


def _of_case(case: Case) -> dict[str, tuple[float, float, bool] | None]:
    """Return value / truth, relative error, and whether the interval holds; None if not known."""
    loop, truth = recorded(case)
    report = report_of_loop(loop)
    ran = [each.total for each in report.choices if each.name == AS_RUN]
    left = float(np.sqrt(np.square(truth.residual_nm[len(loop.slopes) // 2 :]).mean()))
    pairs = {
        "delay": (_values(report, "loop", "delay"), case.delay_frames),
        "noise": (_values(report, "noise", "noise of a slope"), truth.noise_px),
        "r0": (_values(report, "turbulence", "r0 at 500 nm"), case.r0_m),
        "gain of x relative to y": (_values(report, "noise", "gain of x relative to y"), 1.0),
        "outer scale": (_values(report, "turbulence", "outer scale"), case.outer_scale_m),
        "residual": (ran, left),
    }
    found: dict[str, tuple[float, float, bool] | None] = dict.fromkeys(pairs)
    for name, (values, true) in pairs.items():
        for each in values:
            low, high = each.interval
            found[name] = each.value / true, each.error / true, low <= true <= high
    return found


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


def _values(report: LoopReport, part: str, name: str) -> list[Measured]:
    return [each for each in report.parts[part].known if each.name == name]


def _value(report: LoopReport, part: str, name: str) -> Measured:
    return _values(report, part, name)[0]


def _wind_error(report: LoopReport, configuration: LoopConfiguration) -> float:
    """Return the largest distance of a layer's true wind from the nearest one found."""
    assert report.turbulence is not None
    true = winds_of(configuration).T
    apart = np.hypot(*(true[:, :, None] - report.turbulence.turbulence.wind_m_per_s.T[:, None]))
    return float(apart.min(axis=1).max())
