"""Which estimator and control suit a closed loop: tuned and scored by quick simulations of it."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.checks import number_between
from faintspot.compare.choosing import coordinate_search
from faintspot.compare.running import Advance, Unit, Workplace, run_units
from faintspot.compare.store import Arrays, ZarrStore
from faintspot.control.learning import INTEGRATOR
from faintspot.errors import InputError
from faintspot.loop.arms import ArmKind, Choice, Tunable
from faintspot.loop.configuration import LoopConfiguration
from faintspot.loop.files import make_folder
from faintspot.loop.magnitude import scored_run, unit_store, with_flux
from faintspot.loop.simulation import simulate_loop
from faintspot.loop.tuning import FIRST_TUNING_REALISATION
from faintspot.planner.loop_answer import LoopAnswer, LoopArmResult
from faintspot.planner.loop_question import LoopQuestion

_PREPARING_FRAMES = 150  # that calibrating a run and making its air take as long as
_LEARNING_FRAMES = 1500  # the same for control that learns
_TRIALS = 14  # settings that are tried for an arm, about


@dataclass(frozen=True)
class LoopPlan:
    """How much is simulated.

    Parameters
    ----------
    fluxes : int
        Measured ones; what is between is interpolated.
    tuning_frames, tuning_settle_frames : int
        Of every setting that is tried, on one realisation of the air; not scored at the beginning.
    frames, settle_frames : int
        Of a scored run.
    realisations : int
        Of the air that is scored, the same for all.
    """

    fluxes: int = 5
    tuning_frames: int = 120
    tuning_settle_frames: int = 40
    frames: int = 360
    settle_frames: int = 60
    realisations: int = 4

    def __post_init__(self) -> None:
        lowest = {
            "fluxes": 3,
            "tuning_frames": self.tuning_settle_frames + 1,
            "frames": self.settle_frames + 1,
            "realisations": 1,
        }
        for name, value in vars(self).items():
            number_between(f"plan.{name}", value, lowest.get(name, 0), 10**6, integer=True)

    def configuration(self, loop: LoopConfiguration) -> LoopConfiguration:
        """Return a loop with the length and number of scored runs."""
        run = {name: getattr(self, name) for name in ("frames", "settle_frames", "realisations")}
        return loop.replace("run", **run, photons_per_subaperture=())

    def sizes(self, loop: LoopConfiguration) -> tuple[int, int, int]:
        """Return about how much work are: tuning an arm, scoring a run, and an arm that learns."""
        trial, score = (_PREPARING_FRAMES + frames for frames in (self.tuning_frames, self.frames))
        learning = loop.control.telemetry_frames + _LEARNING_FRAMES
        return _TRIALS * trial, score, learning + 3 * trial + self.realisations * score


def tune_loop(
    question: LoopQuestion,
    folder: str | Path,
    *,
    plan: LoopPlan | None = None,
    place: Workplace | None = None,
    overwrite: bool = False,
) -> LoopAnswer:
    """Find out which estimator and control suit a closed loop, and with which settings.

    Every candidate is tuned at every flux on short runs with air of their own: first some values of each
    option in turn, then steps to neighbouring values while these help. It is scored on other realisations of
    the air, which are the same for all. Where control learns, the estimator's options are those that were
    tuned with the integrator. Of the default candidates those that learn are begun only while there is time.

    Parameters
    ----------
    question : LoopQuestion
    folder : path
        Where finished units are remembered; made where it is not there. Interrupted, the same call goes on.
    plan : LoopPlan, optional
    place : Workplace, optional
        Where the work is done. Default: processes on this machine.
    overwrite : bool
        Whether another question's units in the folder are replaced.

    Raises
    ------
    InputError
        For a question of the wrong kind, or a folder that holds another question's units.
    MissingExtraError
        When HCIPy, zarr, or Dask where it is needed, is not installed.

    Examples
    --------
    >>> from faintspot.loop import load_loop
    >>> from faintspot.planner import LoopQuestion, tune_loop
    >>> question = LoopQuestion(load_loop("canary"), magnitudes=(10.0, 13.0))
    >>> answer = tune_loop(question, "loop-tune")  # doctest: +SKIP
    """
    if not isinstance(question, LoopQuestion):
        raise InputError(f"question: expected a LoopQuestion, got {type(question).__name__}")
    return _Tuning(
        question, make_folder(folder), plan or LoopPlan(), place or Workplace(), overwrite
    ).answer()


def tuning_unit(
    kind: ArmKind, configuration: LoopConfiguration, plan: LoopPlan, known: Choice, advance: Advance
) -> dict[str, NDArray[Any]]:
    """Return the choice for an arm at one flux, as arrays that can be stored; `known` values stay."""
    run = configuration.replace("run", frames=plan.tuning_frames, settle_frames=plan.tuning_settle_frames)
    frames = 0

    def strehl(choice: Choice) -> float:
        nonlocal frames
        arm = kind.arm(run, {**known, **choice})
        record = simulate_loop(run, [arm], realisation=FIRST_TUNING_REALISATION)
        advance(frames := frames + _PREPARING_FRAMES + plan.tuning_frames)
        return float(record.mean_strehl())

    tuned = {name: each for name, each in kind.tuned(run).items() if name not in known}
    choice = {**known, **best_choice(tuned, strehl)}
    return {"choice": np.asarray(json.dumps(choice))}


def learning_unit(
    kind: ArmKind, configuration: LoopConfiguration, plan: LoopPlan, known: Choice, advance: Advance
) -> dict[str, NDArray[Any]]:
    """Tune an arm whose control learns, and score it on every realisation, in the process that has learnt."""
    tuned = tuning_unit(kind, configuration, plan, known, advance)
    choice = _choice(tuned)
    runs = [scored_run(kind, configuration, choice, run, _ignored) for run in range(plan.realisations)]
    return {**tuned, **{name: np.array([run[name] for run in runs]) for name in ("strehl", "centroid_gain")}}


def best_choice(tuned: Mapping[str, Tunable], score: Callable[[Choice], float]) -> dict[str, Any]:
    """Return the values with the highest score: of the first look along each axis, then neighbours."""
    seen: dict[tuple[Any, ...], float] = {}

    def scored(choice: Choice) -> float:
        key = tuple(choice[name] for name in tuned)
        if key not in seen:
            seen[key] = score(choice)
        return seen[key]

    best = coordinate_search(
        {name: _middle_first(each.first) for name, each in tuned.items()},
        lambda choice, name, values: [-scored({**choice, name: value}) for value in values],
    )
    for name, each in tuned.items():
        place = each.values.index(best[name])
        for step in (1, -1):
            while 0 <= place + step < len(each.values):
                other = {**best, name: each.values[place + step]}
                if scored(other) <= scored(best):
                    break
                best, place = other, place + step
    return best


def values_at_end(kind: ArmKind, configuration: LoopConfiguration, choice: Choice) -> tuple[str, ...]:
    """Return which chosen values are the first or last that were on offer, but could be beyond."""
    declared = kind.estimator.declared()
    found = []
    for name, each in kind.tuned(configuration).items():
        if len(each.values) < 2 or isinstance(choice[name], str):
            continue
        limits = (declared[name].low, declared[name].high) if name in declared else ()
        if choice[name] in (min(each.values), max(each.values)) and choice[name] not in limits:
            found.append(name)
    return tuple(found)


class _Tuning:
    """The work in three stages: tune, score, and both where control learns, as far as the time goes."""

    def __init__(
        self, question: LoopQuestion, folder: Path, plan: LoopPlan, place: Workplace, overwrite: bool
    ) -> None:
        self._question, self._plan, self._place = question, plan, place
        self._folder, self._overwrite = folder, overwrite
        self._base = plan.configuration(question.configuration)
        self._fluxes = question.photons(plan.fluxes)
        self._plain = [kind for kind in question.kinds if kind.control == INTEGRATOR]
        self._learning = [kind for kind in question.kinds if kind.control != INTEGRATOR]
        self._tune_size, self._score_size, self._learn_size = plan.sizes(question.configuration)
        runs = len(self._plain) * len(self._fluxes)
        self._later = runs * (self._tune_size + plan.realisations * self._score_size)
        self._later += len(self._learning) * len(self._fluxes) * self._learn_size
        self._started, self._done = time.monotonic(), 0

    def answer(self) -> LoopAnswer:
        """Do what is not done yet, and return what all of it says."""
        choices = self._tuned()
        results = self._scored(choices)
        left_out = dict(self._question.left_out)
        for kind in self._learning:
            result = self._learnt(kind, choices)
            if isinstance(result, str):
                left_out[kind.name] = result
            else:
                results.append(result)
        frames = self._plan.frames - self._plan.settle_frames
        return LoopAnswer(self._question, tuple(results), np.array(self._fluxes), frames, left_out)

    def _tuned(self) -> dict[str, dict[str, Any]]:
        """Return the choices of the arms with the integrator, by `_key`."""
        units = [
            Unit(_key(kind, flux), (kind, self._star(flux), self._plan, {}), self._tune_size)
            for kind in self._plain
            for flux in self._fluxes
        ]
        found = self._run("tuning", tuning_unit, units)
        return {unit.key: _choice(found[unit.key]) for unit in units}

    def _scored(self, choices: Mapping[str, Choice]) -> list[LoopArmResult]:
        """Return the results of these arms."""
        runs = range(self._plan.realisations)
        # Realisation by realisation: a process makes the air once for all of its runs.
        units = [
            Unit(
                f"{_key(kind, flux)}-{run}",
                (kind, self._star(flux), choices[_key(kind, flux)], run),
                self._score_size,
            )
            for run in runs
            for kind in self._plain
            for flux in self._fluxes
        ]
        found = self._run("scoring", scored_run, units)

        def of(kind: ArmKind, name: str) -> NDArray[np.float64]:
            return np.array(
                [[found[f"{_key(kind, flux)}-{run}"][name] for run in runs] for flux in self._fluxes]
            )

        return [
            self._result(
                kind,
                [choices[_key(kind, flux)] for flux in self._fluxes],
                of(kind, "strehl"),
                of(kind, "centroid_gain"),
            )
            for kind in self._plain
        ]

    def _learnt(self, kind: ArmKind, choices: Mapping[str, Choice]) -> LoopArmResult | str:
        """Return the result of an arm whose control learns, or why there is no time for it."""
        plain, units = replace(kind, control=INTEGRATOR), []
        for flux in self._fluxes:
            star = self._star(flux)
            known = {k: v for k, v in choices[_key(plain, flux)].items() if k in kind.tuned(star)}
            units.append(Unit(_key(kind, flux), (kind, star, self._plan, known), self._learn_size))
        why = self._no_time(units)
        if why:
            self._later -= sum(unit.size for unit in units)
            return why
        found = self._run("learning", learning_unit, units)
        results = [found[unit.key] for unit in units]
        return self._result(
            kind,
            [_choice(each) for each in results],
            np.array([each["strehl"] for each in results]),
            np.array([each["centroid_gain"] for each in results]),
        )

    def _result(
        self,
        kind: ArmKind,
        choices: Sequence[Choice],
        strehl: NDArray[np.float64],
        centroid_gain: NDArray[np.float64],
    ) -> LoopArmResult:
        stars = [self._star(flux) for flux in self._fluxes]
        ends = [values_at_end(kind, *each) for each in zip(stars, choices, strict=True)]
        return LoopArmResult(kind, tuple(choices), strehl, centroid_gain, tuple(ends))

    def _star(self, flux: float) -> LoopConfiguration:
        return with_flux(self._base, flux)

    def _no_time(self, units: list[Unit]) -> str:
        """Say why units are not begun, "" where they are: they were asked for, are done, or there is time."""
        store = self._store("learning", units)
        left = sum(unit.size for unit in units if not store.done(unit.key))
        if self._question.arms is not None or not left or not self._done:
            return ""
        minutes = (time.monotonic() - self._started) / 60
        expected = minutes * (1 + left / self._done)
        if expected <= self._question.minutes:
            return ""
        return (
            f"after {minutes:.1f} minutes it would have taken until minute {expected:.1f}, beyond the "
            f"{self._question.minutes:g} that were given; started again, it goes on with it"
        )

    def _run(self, stage: str, function: Callable[..., Arrays], units: list[Unit]) -> Mapping[str, Arrays]:
        """Run a stage's units; the progress is that of all stages."""
        self._later -= sum(unit.size for unit in units)
        before, told, total = self._done, self._place.progress, 0

        def progress(done: int, of_stage: int) -> None:
            nonlocal total
            total = of_stage
            if told is not None:
                told(before + done, before + of_stage + self._later)

        place = replace(self._place, progress=progress)
        found = run_units(function, units, self._store(stage, units), place)
        self._done = before + total
        return found

    def _store(self, stage: str, units: list[Unit]) -> ZarrStore:
        experiment = with_flux(self._base, 1.0), self._plan  # stars and arms may be added
        try:
            return unit_store(self._folder, stage, experiment, units, overwrite=False)
        except InputError:
            if not self._overwrite:
                raise
            return unit_store(self._folder, stage, experiment, units, overwrite=True)


def _key(kind: ArmKind, flux: float) -> str:
    return f"{kind.name}-{flux:g}"


def _choice(result: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
    choice: dict[str, Any] = json.loads(str(result["choice"]))
    return choice


def _middle_first(values: Sequence[Any]) -> list[Any]:
    middle = values[len(values) // 2]
    return [middle, *(value for value in values if value != middle)]


def _ignored(done: int) -> None:
    pass
