"""Comparison of controls in one loop: each tuned, or learnt, and scored in turbulence of its own."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import faintspot as fs
from benchmarks.loops.foreign import reports, rivals
from benchmarks.loops.foreign.base import SETTLE_FRAMES, Control, Floats, ForeignLoop, Integrator, Observed
from benchmarks.loops.foreign.oopao import CHANGED_AFTER
from faintspot.base.statistics import paired_mean
from faintspot.loop.control.reconstructor import make_reconstructor
from faintspot.loop.telemetry.choices import FILTER

TUNING_SEED, LEARNING_SEED = 1, 2
INTEGRATOR = "integrator"
_IN_LOOP = 2
"""Predictors of the rivals, the best in a replay, that are tried in the loop."""
_TIMED_FRAMES = 300


@dataclass(frozen=True)
class Effort:
    """Number of frames, seeds and gains."""

    frames: int = 700
    learning_s: float = 8.0
    seeds: tuple[int, ...] = (6, 7, 8)
    gains: tuple[float, ...] = (0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 1.0, 1.2, 1.5, 1.8)
    with_others: bool = True
    """Whether pyRTC's predictors are compared, and brighter stars tried."""

    def of(self, loop: ForeignLoop) -> Effort:
        """Return the effort for a loop: half as many gains, and no pyRTC, if it is slow."""
        return replace(self, gains=self.gains[::2], with_others=False) if loop.is_slow else self


QUICK = Effort(250, 3.0, (3, 4), (0.4,), with_others=False)


class Runs:
    """Runs of one loop; those with controls that do not learn are kept, as they repeat exactly.

    Parameters
    ----------
    loop : ForeignLoop
    effort : Effort
    folder : Path
    """

    def __init__(self, loop: ForeignLoop, effort: Effort, folder: Path) -> None:
        self.loop, self.effort, self._folder = loop, effort.of(loop), folder

    def run(
        self, label: str, make: Callable[[], Control], seed: int, frames: int, *, turned: bool = False
    ) -> Observed:
        """Run the loop, or return the run of the same label."""
        name = f"{self.loop.name}-{label}-{seed}-{frames}{'-turned' * turned}"
        path = self._folder / f"{re.sub('[^-.a-z0-9]+', '_', name.lower())}.npz"
        if not path.exists():
            observed = self.loop.run(make(), seed, frames, turned=turned)
            unfinished = path.with_suffix(".part.npz")
            np.savez(unfinished, **vars(observed))
            unfinished.replace(path)
        with np.load(path) as arrays:
            return Observed(**arrays)

    def integrator(self, name: str, reconstructor: Floats, gain: float, seed: int, frames: int) -> Observed:
        """Run the loop with an integrator."""
        return self.run(f"{name} {gain:g}", lambda: Integrator(self.loop, reconstructor, gain), seed, frames)

    def best_gain(
        self, name: str, reconstructor: Floats, start: float | None = None
    ) -> tuple[float, dict[str, float]]:
        """Return the best gain of an integrator in the turbulence for tuning, uphill, and all scores."""
        gains, tried = self.effort.gains, dict[float, float]()
        place = len(gains) // 2 - 1 if start is None else gains.index(start)
        while True:
            near = gains[max(0, place - 1) : place + 2]
            for gain in near:
                if gain not in tried:
                    run = self.integrator(name, reconstructor, gain, TUNING_SEED, self.effort.frames)
                    tried[gain] = run.score
            best = max(near, key=tried.__getitem__)
            if best == gains[place]:
                return best, {f"{gain:g}": round(tried[gain], 4) for gain in sorted(tried)}
            place = gains.index(best)


@dataclass
class Commissioned:
    """Loop with its tuned integrator, a recording of it, and the filter learnt from that."""

    runs: Runs
    gain: float
    tried: dict[str, float]
    learning: Observed
    control: Any
    learning_s: float

    @property
    def loop(self) -> ForeignLoop:
        """The loop."""
        return self.runs.loop

    @property
    def tuning(self) -> Observed:
        """Run of the integrator in the turbulence for tuning."""
        return self.plain(TUNING_SEED)

    def plain(self, seed: int, *, turned: bool = False) -> Observed:
        """Run the tuned integrator."""
        label = f"{INTEGRATOR} {self.gain:g}"
        return self.runs.run(label, self.integrator, seed, self.runs.effort.frames, turned=turned)

    def integrator(self) -> Integrator:
        """Return the tuned integrator."""
        return Integrator(self.loop, make_reconstructor(self.loop.interaction).matrix, self.gain)

    def fresh(self) -> Any:
        """Return the learnt control at its start."""
        self.control.reset()
        return self.control


Log = Callable[[str], None]


def commissioned(runs: Runs, log: Log) -> Commissioned:
    """Choose the integrator's gain, record the loop with it, and learn."""
    loop, effort = runs.loop, runs.effort
    matrix = make_reconstructor(loop.interaction).matrix
    gain, tried = runs.best_gain(INTEGRATOR, matrix)
    log(f"integrator {gain:g}: {tried}")
    frames = SETTLE_FRAMES + round(effort.learning_s * loop.rate_hz)
    learning = runs.integrator(INTEGRATOR, matrix, gain, LEARNING_SEED, frames)
    begun = time.perf_counter()
    control = fs.control.learn(recording_of(loop, learning))
    seconds = time.perf_counter() - begun
    log(f"learnt in {seconds:.1f} s: {control.summary()}")
    return Commissioned(runs, gain, tried, learning, control, seconds)


def recording_of(loop: ForeignLoop, observed: Observed) -> Any:
    """Return what a user records of a run."""
    rows = slice(SETTLE_FRAMES, None)
    slopes, commands = observed.slopes[rows], observed.commands[rows]
    return fs.control.Recording(
        slopes,
        commands,
        loop.interaction,
        None if loop.is_modal else loop.cells,
        loop.rate_hz,
        subaperture_m=loop.subaperture_m,
        pixel_scale_arcsec=None if loop.is_modal else loop.unit_arcsec,
    )


def compared(ready: Commissioned, log: Log) -> dict[str, Any]:
    """Score integrators, pyRTC's predictors and the filter; compare the report with the loop."""
    runs, loop, effort = ready.runs, ready.loop, ready.runs.effort
    scores: dict[str, list[float]] = {
        INTEGRATOR: [ready.plain(seed).score for seed in effort.seeds],
    }
    log(f"{INTEGRATOR}: {scores[INTEGRATOR]}")
    filtered = [loop.run(ready.fresh(), seed, effort.frames) for seed in effort.seeds]
    scores[FILTER] = [run.score for run in filtered]
    log(f"{FILTER}: {scores[FILTER]}")
    report = None
    if not loop.is_modal:
        report = reports.reported(recording_of(loop, ready.learning), dict(scores), loop.r0_m)
        log(f"report: {report['advice']} r0 {report['r0']}")
    chosen = {INTEGRATOR: f"gain {ready.gain:g}", FILTER: ""}
    for name, matrix in loop.own.items():
        gain, _ = runs.best_gain(name, matrix)
        own = [runs.integrator(name, matrix, gain, seed, effort.frames).score for seed in effort.seeds]
        scores[name], chosen[name] = own, f"gain {gain:g}"
    if effort.with_others and rivals.available() and not loop.is_modal:
        for name in rivals.GRIDS:
            for text, gain in (("as calibrated", 1.0), ("gain corrected", _rounded(ready))):
                label = f"pyRTC {name}, {text}"
                chosen[label], scores[label] = _rival(ready, name, gain)
                log(f"{label}: {chosen[label]}, {scores[label]}")
    return {
        "scores": scores,
        "chosen": chosen,
        "ahead": {name: _ahead(scores[FILTER], values) for name, values in scores.items() if name != FILTER},
        "predicting": [float(run.predicting.mean()) for run in filtered],
        "report": report,
    }


def _rounded(ready: Commissioned) -> float:
    return max(0.02, 0.02 * round(float(ready.control.centroid_gain.value) / 0.02))


def _rival(ready: Commissioned, name: str, gain: float) -> tuple[str, list[float]]:
    """Return options and scores of a predictor, tuned in a replay and then in the loop."""
    runs, effort = ready.runs, ready.runs.effort
    first = rivals.candidates(name, ready.loop, ready.learning, ready.tuning, gain)[:_IN_LOOP]
    labelled = [(f"{name} {gain:g} {label}", label, make) for label, make in first]
    tuned = [runs.run(label, make, TUNING_SEED, effort.frames).score for label, _, make in labelled]
    label, options, make = labelled[int(np.argmax(tuned))]
    return options, [runs.run(label, make, seed, effort.frames).score for seed in effort.seeds]


def turned(ready: Commissioned, log: Log) -> dict[str, Any]:
    """Score integrator and filter after the winds reverse, which plays the turbulence backwards."""
    effort, second = ready.runs.effort, round(ready.loop.rate_hz)
    parts = {
        "forward": slice(SETTLE_FRAMES, effort.frames),
        "first 100 frames": slice(effort.frames, effort.frames + 100),
        "from 1 s on": slice(effort.frames + second, None),
    }
    scores: dict[str, dict[str, list[float]]] = {part: {INTEGRATOR: [], FILTER: []} for part in parts}
    switched: list[int] = []
    for seed in effort.seeds:
        both = {
            INTEGRATOR: ready.plain(seed, turned=True),
            FILTER: ready.loop.run(ready.fresh(), seed, effort.frames, turned=True),
        }
        for name, run in both.items():
            for part, rows in parts.items():
                scores[part][name].append(float(run.strehl[rows].mean()))
        plain = np.flatnonzero(both[FILTER].predicting[effort.frames :] == 0)
        switched.append(int(plain[0]) if plain.size else -1)
    ahead = {
        part: {INTEGRATOR: _ahead(values[FILTER], values[INTEGRATOR])} for part, values in scores.items()
    }
    log(f"{ahead}, switched {switched}")
    return {"parts": scores, "ahead_of_parts": ahead, "switched_after_frames": switched}


def changed(ready: Commissioned, log: Log) -> dict[str, Any]:
    """Score integrator and filter after other winds, with the control learning again beside the loop.

    Frames have the pace of the loop, as learning takes its time.
    """
    loop, rate, begin = ready.loop, round(ready.loop.rate_hz), CHANGED_AFTER
    loop.is_changing = True  # not in the recording that it learnt from
    parts = {
        "before": slice(SETTLE_FRAMES, begin),
        "first second": slice(begin, begin + rate),
        "until 15 s": slice(begin + rate, begin + 15 * rate),
        "from 15 s on": slice(begin + 15 * rate, begin + 18 * rate),
    }
    scores: dict[str, dict[str, list[float]]] = {part: {INTEGRATOR: [], FILTER: []} for part in parts}
    for seed in ready.runs.effort.seeds:
        control = ready.fresh()
        control.relearn = "background"
        both = {
            INTEGRATOR: loop.run(ready.integrator(), seed, begin + 18 * rate),
            FILTER: loop.run(_Paced(control, loop.rate_hz), seed, begin + 18 * rate),
        }
        log(f"seed {seed}: {control.relearnt}")
        for name, run in both.items():
            for part, rows in parts.items():
                scores[part][name].append(float(run.strehl[rows].mean()))
        ready.control = fs.control.learn(recording_of(loop, ready.learning))
    ahead = {
        part: {INTEGRATOR: _ahead(values[FILTER], values[INTEGRATOR])} for part, values in scores.items()
    }
    log(f"{scores}, {ahead}")
    return {"parts": scores, "ahead_of_parts": ahead}


class _Paced:
    """Control whose frames come at the rate of the loop, or later."""

    def __init__(self, control: Any, rate_hz: float) -> None:
        self._control, self._period_s, self._next_s = control, 1 / rate_hz, time.perf_counter()

    @property
    def is_predicting(self) -> bool:
        """Whether the filter drives."""
        return bool(self._control.is_predicting)

    def __call__(self, slopes: Floats) -> Floats:
        """Wait for the frame, and return its command."""
        time.sleep(max(0.0, self._next_s - time.perf_counter()))
        self._next_s += self._period_s
        return np.asarray(self._control(slopes))


def learnt(ready: Commissioned) -> dict[str, Any]:
    """Return what was learnt, with the truth where it is known, and the times."""
    control, loop = ready.control, ready.loop
    gain, delay = control.centroid_gain, control.delay_frames
    true = loop.true_gain(ready.integrator(), TUNING_SEED, len(ready.tuning.slopes))
    winds = [
        {"speed": wind.speed.value, "direction": wind.direction.value, "share": wind.share.value}
        for wind in control.winds
    ]
    control.reset()
    begun = time.perf_counter()
    for slopes in ready.learning.slopes[:_TIMED_FRAMES]:
        control(slopes)
    frame_us = (time.perf_counter() - begun) / _TIMED_FRAMES * 1e6
    return {
        "delay": [delay.value, delay.error, loop.delay_frames],
        "centroid_gain": [gain.value, gain.error, true],
        "winds": winds,
        "true_winds": loop.winds,
        "summary": control.summary(),
        "learning_s": ready.learning_s,
        "frame_us": frame_us,
    }


def _ahead(ours: list[float], theirs: list[float]) -> list[float]:
    """Return the mean paired difference and its standard error."""
    difference = paired_mean(np.array(ours) - np.array(theirs))
    return [difference.value, difference.standard_error]
