"""The Kalman filter and its winds: learnt, true and none; and winds that drift while the loop runs.

Winds, strengths, outer scale, noise and vibrations are learnt from telemetry of an integrator; all is scored
on other turbulence. In winds that drift, the filter is learnt again and handed over as beside an engine.
"""

from functools import partial
from typing import NamedTuple, cast

import numpy as np

from benchmarks.loops.prediction import SETTLE, VIBRATION_NM, Case, Floats, Run
from benchmarks.measuring import Row, Table
from faintspot.base.statistics import paired_mean
from faintspot.engine.control.guard import ControllerSuccessor, PreparedController
from faintspot.loop.control.base import ASSUMED, WINDS, CommandDelayLine, Controller
from faintspot.loop.control.identification.model import Kalman
from faintspot.loop.control.kalman.guard import HANDOVER_FRAMES
from faintspot.loop.control.relearning import RelearntControl, relearn

CASES = {
    "diffraction_limit, 20 photons": Case(20.0, 0.0),
    "diffraction_limit, 20 photons, vibration": Case(20.0, VIBRATION_NM),
    "camera_3e, 60 photons": Case(60.0, 0.0, "camera_3e", 4.0),
}
REALISATIONS, FRAMES = 5, 1000
DRIFT, DRIFT_DEG, DRIFT_S, DRIFT_TARGET = 0.2, 20.0, 60.0, 0.66
LEARN_EVERY_S, LEARNING_TAKES_S = 10.0, 2.0


def run() -> list[Table]:
    """Compare winds, and let them drift."""
    return [*(winds_table(name, case) for name, case in CASES.items()), drift_table()]


def winds_table(name: str, case: Case) -> Table:
    """Measure the filter with each kind of winds, and the integrator."""
    learning, tuning = case.telemetry()
    makes = {"integrator": case.integrator(tuning)}
    makes |= {winds: partial(case.learnt(learning, winds).guarded, case.plant) for winds in WINDS}
    strehl = {
        each: np.array([case.observed(make, realisation, FRAMES)[0] for realisation in range(REALISATIONS)])
        for each, make in makes.items()
    }
    rows = []
    for each, runs in strehl.items():
        mean, behind = paired_mean(runs), paired_mean(runs - strehl[ASSUMED])
        values = {"Strehl": mean.value, "error": mean.standard_error}
        rows.append(Row(each, values | {"minus true": behind.value, "error of that": behind.standard_error}))
    notes = [f"{REALISATIONS} realisations of {FRAMES} frames, paired"]
    return Table(f"winds-{name}", f"Winds of the Kalman filter, {name}", rows, notes)


def drift_table() -> Table:
    """Measure the filter in winds that drift; it is learnt again as beside an engine."""
    case = Case(20.0, 0.0)
    learnt = case.learnt(case.telemetry()[0])
    runs = [drifting(case, learnt, realisation) for realisation in range(REALISATIONS)]
    rows = []
    for period, each in enumerate(np.transpose([run.strehl for run in runs])):
        mean = paired_mean(each)
        values = {"Strehl": mean.value, "error": mean.standard_error, "lowest": each.min()}
        times = f"{period * LEARN_EVERY_S:g} to {(period + 1) * LEARN_EVERY_S:g} s"
        rows.append(Row(times, values, f">= {DRIFT_TARGET:g}", bool(each.min() >= DRIFT_TARGET)))
    about = f"Winds that drift by {DRIFT:.0%} and {DRIFT_DEG:g} degrees in {DRIFT_S:g} s"
    at, other = np.max([run.changes_nm for run in runs], axis=0)
    notes = [
        f"{REALISATIONS} realisations; filters handed over: {[run.handed_over for run in runs]}",
        f"largest rms change of commands in a frame: {at:.0f} nm at a handover, {other:.0f} nm otherwise",
    ]
    return Table("winds-drift", about, rows, notes)


class Drifted(NamedTuple):
    """What came out in winds that drift."""

    strehl: Floats
    """(periods,): means between learnings."""
    handed_over: int
    """Number of filters."""
    changes_nm: tuple[float, float]
    """Largest rms change of commands from frame to frame: at a handover, and otherwise."""


def drifting(case: Case, learnt: Kalman, realisation: int) -> Drifted:
    """Simulate a run; filters are learnt and handed over as beside an engine."""
    every, later = (round(each * case.rate_hz) for each in (LEARN_EVERY_S, LEARNING_TAKES_S))
    run = Run(case, realisation, round(DRIFT_S * case.rate_hz))
    running, controller = learnt, cast(Controller, learnt.guarded(case.plant, run.line))
    change, at_handover = np.zeros((2, len(run.strehl)))
    wind, successor = run.model.atmosphere.velocity, None
    found: RelearntControl | None = None
    while run.frame < len(run.strehl):
        part = run.frame / len(run.strehl)
        now = (1 + DRIFT * part) * wind @ _rotation(DRIFT_DEG * part)
        run.model.atmosphere = run.model.atmosphere.blown(now, run.time_s)
        last, before = run.frame, run.line.latest.copy()
        run.step(controller)
        change[last] = np.sqrt(np.mean(np.square(run.line.latest - before)))
        if successor is not None and successor.is_settling:
            own = run.slopes[last]
            successor.follow(run.line, own, run.errors[last], np.zeros(len(own) // 2), own, None)
        elif successor is not None:
            controller = successor.take_over(run.line).controller
            run.line = controller.line
            successor, at_handover[run.frame : run.frame + HANDOVER_FRAMES] = None, 1.0
        if run.frame % every == 0 and run.frame < len(run.strehl):
            telemetry = run.telemetry(run.frame - every, run.frame)
            start = None if found is None else found.learnt.identified
            found = relearn(case.plant, running, telemetry, case.site, case.rate_hz, start)
        if run.frame % every == later and found is not None and found.is_better:
            running, line = found.learnt, CommandDelayLine(len(run.line.latest), run.line.delay_frames)
            ready = PreparedController("kalman", found.learnt.guarded(case.plant, line), False, 1.0)
            successor = ControllerSuccessor(ready)
    run.strehl[:SETTLE], change[:SETTLE] = np.nan, 0.0
    largest = float((at_handover * change).max()), float((change - at_handover * change).max())
    count = round(at_handover.sum() / HANDOVER_FRAMES)
    return Drifted(np.nanmean(run.strehl.reshape(-1, every), axis=1), count, largest)


def _rotation(degrees: float) -> Floats:
    """Return the matrix that turns rows of two numbers."""
    cos, sin = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return np.array([[cos, sin], [-sin, cos]])
