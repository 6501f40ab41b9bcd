"""How well a recorded loop tells delay, noise, turbulence, vibrations and what other control would leave.

Loops near the diffraction limit are simulated and reported as `faintspot telemetry` does. Their delay is not
given. Random loops have HCIPy's turbulence or a vibration. Those of one flux are run again in the same
turbulence with another gain and with the predictive filter, which shows what these really leave.
"""

import cmath
import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from benchmarks.loops.recorded_loops import Truth, drawn_cases, recorded, winds_of
from benchmarks.measuring import Row, Table
from faintspot.loop.control.identification.open_loop import Measured
from faintspot.loop.control.identification.recording import Recording
from faintspot.loop.simulation import LoopRecord, Method, load_loop, simulate_loop
from faintspot.loop.slope_covariance import ARCSEC
from faintspot.loop.telemetry.choices import AS_RUN, FILTER
from faintspot.loop.telemetry.report import LoopReport, report_of_loop
from faintspot.slopes.pipeline.settings import Settings

Pairs = dict[str, list[tuple[Measured, float]]]
"""Values of a report, each with the truth."""

FRAMES, REALISATIONS = 3000, range(40, 47)
RANDOM_LOOPS, RANDOM_SEED = 10, 7
"""Realisations and a seed on which nothing was chosen."""
GAINS = {20.0: (0.17, 0.1), 200.0: (0.4, 0.25)}
"""Gain of the recorded loop and of the other one, by photons per sub-aperture and frame."""
_LIMITS = {
    "delay": (0.1, 0.0),
    "noise of a slope": (0.0, 0.05),
    "r0 at 500 nm": (0.0, 0.03),
    "speed (m/s)": (1.0, 0.0),
    "direction (degrees)": (5.0, 0.0),
    "frequency of the vibration (Hz)": (0.3, 0.0),
    "rms of the vibration (nm)": (0.0, 0.15),
    "residual as it ran": (0.0, 0.07),
    "residual with another gain": (0.0, 0.07),
    "residual of the filter": (0.0, 0.07),
}
"""Largest difference from the truth for a useful report: a number, and a part of the truth."""
_LEAST_SHARE = 0.15  # of a layer, for its wind to be compared
_SAME_LINE_HZ = 1.0


def recording(record: LoopRecord) -> Recording:
    """Return a simulated loop as a recording: the command of each row follows from its slopes."""
    loop = record.loop
    later, first = loop.control.delay_frames, loop.run.settle_frames
    slopes = record.slopes_px.astype(np.float64) / record.centroid_gain[0]
    slopes[~np.tile(record.valid, 2)] = np.nan
    return Recording(
        slopes[first:-later],
        record.commands[first + later :],
        record.interaction_matrix,
        record.cells,
        loop.control.frame_rate_hz,
        subaperture_m=loop.subaperture_m,
        pixel_scale_arcsec=loop.pixel_scale_rad / ARCSEC,
        slope_unit="px",
        name="simulated",
    )


def run() -> list[Table]:
    """Report random loops, and loops at each flux."""
    cases = (recorded(case) for case in drawn_cases(RANDOM_LOOPS, RANDOM_SEED))
    random = (compared(report_of_loop(loop), truth) for loop, truth in cases)
    note = "20 to 300 photons, r0 0.18 to 0.32 m, delay 1 to 3; every second loop has a vibration"
    tables = [table_of("random", "Random recorded loops", random, note)]
    for photons in GAINS:
        found = (_of_flux(photons, realisation) for realisation in REALISATIONS)
        note = f"{FRAMES} frames, diffraction_limit, slopes by window; residuals with fitting and aliasing"
        tables.append(table_of(f"{photons:g}", f"Recorded loops of {photons:g} photons", found, note))
    return tables


def table_of(label: str, title: str, found: Iterable[Pairs], note: str) -> Table:
    """Return how values of many loops compare with the truth."""
    every: Pairs = {}
    for pairs in found:
        for name, values in pairs.items():
            every.setdefault(name, []).extend(values)
    rows = [Row(name, _statistics(name, values)) for name, values in every.items()]
    title = f"{title}: values beside the truth, and share of 95 % intervals that hold"
    return Table(f"telemetry-{label}", title, rows, [note])


def _statistics(name: str, values: list[tuple[Measured, float]]) -> dict[str, float]:
    value, error, truth = np.array([(each.value, each.error, true) for each, true in values]).T
    if np.isnan(truth).any():
        return {"values": float(len(values))}
    apart, held = np.abs(value - truth), [low <= true <= high for low, high, true in _intervals(values)]
    found = {
        "mean difference": float((value - truth).mean()),
        "rms difference": float(np.sqrt(np.square(apart).mean())),
        "largest": float(apart.max()),
        "mean error": float(error.mean()),
        "intervals that hold": float(np.mean(held)),
        "values": float(len(values)),
    }
    if name in _LIMITS:
        number, part = _LIMITS[name]
        found["within limits"] = float(np.mean(apart <= number + part * np.abs(truth)))
    if truth.all():
        found = {"mean value / truth": float((value / truth).mean())} | found
    return found


def _intervals(values: list[tuple[Measured, float]]) -> Iterable[tuple[float, float, float]]:
    return ((*each.interval, true) for each, true in values)


def compared(report: LoopReport, truth: Truth) -> Pairs:
    """Return the values of a report that are known, with the truth."""
    known = {each.name: each for part in report.parts.values() for each in part.values}
    true = {
        "delay": truth.delay_frames,
        "noise of a slope": truth.noise_px,
        "gain of x relative to y": 1.0,
        "rotation of the slopes' axes": 0.0,
        "r0 at 500 nm": truth.r0_m,
        "outer scale": truth.outer_scale_m,
    }
    pairs = {name: [(known[name], value)] for name, value in true.items() if name in known}
    ran = [each.total for each in report.choices if each.name == AS_RUN]
    pairs |= {"residual as it ran": [(each, truth.residual_nm) for each in ran]} if ran else {}
    return pairs | _layers(known, truth) | _vibrations(report, truth)


def _layers(known: dict[str, Measured], truth: Truth) -> Pairs:
    """Return speeds and directions of the layers next to the true ones, if these are strong."""
    numbers = [name.partition(":")[0] for name in known if name.endswith(": share")]
    if not numbers:
        return {}
    winds = [
        cmath.rect(known[f"{each}: speed"].value, math.radians(known[f"{each}: direction"].value))
        for each in numbers
    ]
    pairs: Pairs = {"speed (m/s)": [], "direction (degrees)": []}
    for true in map(complex, *truth.winds_m_per_s[truth.shares > _LEAST_SHARE].T):
        nearest = int(np.argmin(np.abs(np.array(winds) - true)))
        speed, direction = (known[f"{numbers[nearest]}: {what}"] for what in ("speed", "direction"))
        pairs["speed (m/s)"].append((speed, abs(true)))
        turned = math.degrees(cmath.phase(winds[nearest] / true))
        pairs["direction (degrees)"].append((replace(direction, value=360 + turned), 360.0))
    return pairs


def _vibrations(report: LoopReport, truth: Truth) -> Pairs:
    """Return the frequency and rms of the vibration, if it was found, and those that are not there."""
    known, true, pairs = report.parts["vibrations"].values, truth.vibration, Pairs()
    for frequency, rms in zip(known[::2], known[1::2], strict=True):
        is_true = true is not None and frequency.name.endswith(f" {true.mode}")
        if true is not None and is_true and abs(frequency.value - true.frequency_hz) < _SAME_LINE_HZ:
            pairs["frequency of the vibration (Hz)"] = [(frequency, true.frequency_hz)]
            pairs["rms of the vibration (nm)"] = [(rms, truth.vibration_nm)]
        else:
            pairs.setdefault("false vibrations", []).append((rms, math.nan))
    return pairs


def _of_flux(photons: float, realisation: int) -> Pairs:
    """Report a loop of one flux; run it again with another gain and with the filter."""
    configuration = load_loop("diffraction_limit").replace("camera", photons_per_subaperture=photons)
    configuration = configuration.replace("run", frames=FRAMES, settle_frames=100)
    gain, other = GAINS[photons]
    own, second = (Method("window", Settings("window"), gain=each) for each in (gain, other))
    first, *rest = (
        simulate_loop(configuration, [method], realisation=realisation)
        for method in (own, second, replace(own, control="kalman"))
    )
    error = first.standard_error_px[first.scored] / first.centroid_gain[0]
    left = [float(np.sqrt(np.square(each.residual_nm[FRAMES // 2 :]).mean())) for each in (first, *rest)]
    air = configuration.atmosphere
    truth = Truth(
        configuration.control.delay_frames,
        float(np.sqrt(np.square(error[np.isfinite(error)]).mean())),
        float((first.r0_m ** (-5 / 3)).mean() ** (-3 / 5)),
        air.outer_scale_m,
        left[0],
        winds_of(configuration),
        np.array(air.fraction) / sum(air.fraction),
    )
    report = report_of_loop(recording(first))
    return compared(report, truth) | replays(report, other, left[1:])


def replays(report: LoopReport, gain: float, left_nm: list[float]) -> Pairs:
    """Return the replayed residuals of another gain and of the filter, with what these really left."""
    curve = [each for each in report.choices if each.name == "integrator"]
    filters = [each for each in report.choices if each.name == FILTER]
    nearest = sorted(curve, key=lambda each: abs(each.gain - gain))[:1]
    chosen = zip(("residual with another gain", "residual of the filter"), (nearest, filters), strict=True)
    return {
        name: [(each.total, true) for each in found]
        for (name, found), true in zip(chosen, left_nm, strict=True)
        if found
    }
