"""Prediction for the large sensors of an 8 m telescope: Strehl ratios, nothing given.

Slopes by a fixed window. `7 x 7` is `diffraction_limit`, `16 x 16` the same on 8 m, both with the filter in
which all slopes interact beside that of neighbours (FAINTSPOT_DENSE=0 leaves it out); `40 x 40` is
`eight_metre`. The integrator's gain is the best of those around the one that a replay of telemetry chooses,
in a run of the loop; pyRTC's least squares (`pip install pyrtcao`) has the options that leave the least
phase in the replay. Filters and rival learn from the same telemetry, and all are scored on other turbulence.
"""

import importlib.util
import os
import time
from dataclasses import dataclass
from functools import partial
from unittest import mock

import numpy as np

from benchmarks.loops.prediction import Case, Make, rivals
from benchmarks.measuring import Row, Table
from faintspot.base.statistics import paired_mean
from faintspot.loop.control.base import OpenLoopTelemetry
from faintspot.loop.control.identification import model
from faintspot.loop.control.identification.learning import GAINS
from faintspot.loop.simulation import LoopConfiguration

_DENSE = os.environ.get("FAINTSPOT_DENSE", "1") != "0"
REALISATIONS, FRAMES = 5, 400
_LEARNING, _TUNING = 2000, 2001
"""Realisations."""
_TUNING_FRAMES = 400
_RIVAL_OPTIONS = {"order": (4, 8, 16), "regularization": (1e-2, 1e-1)}
_RIVAL_GAINS = 0.7, 0.5, 1.0
INTEGRATOR, NEIGHBOURS, ALL, RIVAL = (
    "integrator",
    "Kalman filter of neighbours",
    "Kalman filter of all slopes",
    "pyRTC's least_squares",
)


@dataclass(frozen=True)
class Large(Case):
    """A large sensor, with the gain of the telemetry to learn from and its number of frames."""

    telemetry_gain: float = 0.2
    telemetry_frames: int = 2050
    is_wide: bool = False
    """Whether the telescope is 8 m wide in place of 4.2 m."""

    @property
    def configuration(self) -> LoopConfiguration:
        """The loop."""
        loop = super().configuration
        if self.is_wide:
            loop = loop.replace("telescope", diameter_m=8.0, obstruction=0.14).replace(
                "sensor", subapertures=16
            )
        return loop

    def tuned_integrator(self, tuning: OpenLoopTelemetry) -> tuple[float, Make]:
        """Return the gain with the highest Strehl ratio near the one that a replay chooses."""
        plant = self.plant
        place = GAINS.index(plant.best_gain(GAINS, tuning, self.phase)[0])
        near = {gain: partial(plant.integrator, gain) for gain in GAINS[max(place - 1, 0) : place + 3]}
        gain = max(near, key=lambda each: self.observed(near[each], _TUNING, _TUNING_FRAMES)[0])
        return gain, near[gain]


CASES = {
    "7 x 7, 20 photons": Large(20.0, 0.0, "diffraction_limit", 2.2),
    "16 x 16, 20 photons": Large(20.0, 0.0, "diffraction_limit", 2.2, is_wide=True),
    "40 x 40, 20 photons": Large(20.0, 0.0, "eight_metre", 3.3, 0.5, 4100),
    "40 x 40, 80 photons": Large(80.0, 0.0, "eight_metre", 3.3, 0.5, 4100),
}


def run() -> list[Table]:
    """Compare the controllers of each sensor."""
    return [_table(name, case) for name, case in CASES.items()]


def _table(name: str, case: Large) -> Table:
    make_telemetry = partial(case.plant.integrator, case.telemetry_gain)
    learnt_from = case.observed(make_telemetry, _LEARNING, case.telemetry_frames)[1]
    tuning = case.observed(make_telemetry, _TUNING, _TUNING_FRAMES * 2)[1]
    gain, integrator = case.tuned_integrator(tuning)
    makes: dict[str, Make] = {INTEGRATOR: integrator}
    seconds = {INTEGRATOR: 0.0}
    for each, most_slopes in ((NEIGHBOURS, 0), (ALL, 10**6)):
        if each == ALL and (case.name != "diffraction_limit" or not _DENSE):
            continue
        begun = time.process_time()
        with mock.patch.object(model, "MOST_SLOPES", most_slopes):
            learnt = case.learnt(learnt_from)
        makes[each], seconds[each] = partial(learnt.guarded, case.plant), time.process_time() - begun
        print(f"{name}, {each}: {learnt.description}", flush=True)
    if importlib.util.find_spec("pyrtc") is not None:
        begun = time.process_time()
        makes[RIVAL] = _rival(case, learnt_from, tuning)
        seconds[RIVAL] = time.process_time() - begun
    strehl = {
        each: np.array([case.observed(make, realisation, FRAMES)[0] for realisation in range(REALISATIONS)])
        for each, make in makes.items()
    }
    rows = []
    for each, runs in strehl.items():
        mean, ahead = paired_mean(runs), paired_mean(runs - strehl[INTEGRATOR])
        values = {"Strehl": mean.value, "error": mean.standard_error, "lowest": float(runs.min())}
        values |= {"minus integrator": ahead.value, "error of that": ahead.standard_error}
        if ALL in strehl:
            behind = paired_mean(runs - strehl[ALL])
            values |= {"minus all slopes": behind.value, "error of it": behind.standard_error}
        rows.append(Row(each, values | {"learning, s": seconds[each]}))
    notes = [f"{REALISATIONS} realisations of {FRAMES} frames; the integrator's gain is {gain:g}"]
    return Table(f"large-{name}", f"Large sensors, {name}", rows, notes)


def _rival(case: Large, learnt_from: OpenLoopTelemetry, tuning: OpenLoopTelemetry) -> Make:
    """Return the rival with the options, then the gain, that leave the least phase."""
    plant, phase = case.plant, case.phase

    def left(make: Make) -> float:
        return plant.residual(make, tuning, phase)

    offered = rivals("least_squares", plant, learnt_from, _RIVAL_OPTIONS, _RIVAL_GAINS[:1])
    best = min(offered, key=left)
    return min((partial(best, gain=gain) for gain in _RIVAL_GAINS), key=left)
