"""Search for the settings of a closed loop, from the best of a coarse grid."""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.checks import number_between
from faintspot.base.text_files import parse_json, to_json
from faintspot.experiments.closed_loop.results import LOOP_GAIN, Tunable, tuned_values, with_choice
from faintspot.experiments.methods import Choice
from faintspot.experiments.running import Advance
from faintspot.loop.control.base import INTEGRATOR
from faintspot.loop.simulation.configuration import LoopConfiguration
from faintspot.loop.simulation.methods import Method
from faintspot.loop.simulation.simulation import simulate_loop

_LEARNING_FRAMES = 3000  # that take as long as learning from telemetry
_FEWEST_FLUXES = 3  # for a line

FIRST_TUNING_REALISATION = 1000
"""Realisations of the air from this one on are tuned on; those before are scored."""


@dataclass(frozen=True)
class Search:
    """Extent of a search for settings.

    Parameters
    ----------
    coarse_frames : int
        Of every combination of the coarse values, with one realisation of the air.
    frames : int
        Of the settings around the best ones, with every realisation; also of the final choice.
    settle_frames : int
        Of these, not scored.
    realisations : int
        Of the refined search.
    finalists : int
        Coarse combinations that are looked at again.
    climbs : int
        Finalists from which steps are taken, the best ones: the best of all may stand on the lower hill.
    rounds : int
        Most steps away from each of them; 0: none.

    Raises
    ------
    InputError
        For numbers out of range.
    """

    coarse_frames: int = 250
    frames: int = 400
    settle_frames: int = 60
    realisations: int = 2
    finalists: int = 4
    climbs: int = 2
    rounds: int = 5

    def __post_init__(self) -> None:
        lowest = {"coarse_frames": self.settle_frames + 1, "frames": self.settle_frames + 1, "rounds": 0}
        for item in fields(self):
            value = getattr(self, item.name)
            number_between(f"search.{item.name}", value, lowest.get(item.name, 1), 10**6, integer=True)


QUICK = Search(coarse_frames=160, frames=160, settle_frames=40, realisations=1, finalists=1, rounds=0)


@dataclass(frozen=True)
class Tuned:
    """Result of a search."""

    choice: Choice
    strehl: float
    """Mean of the tuning runs; the best of many, so higher than that of other runs."""


def tune(
    method: Method,
    configuration: LoopConfiguration,
    search: Search,
    slopes: Choice | None = None,
    advance: Advance | None = None,
) -> dict[str, NDArray[Any]]:
    """Find the settings of a method that give the highest Strehl ratio at the configuration's flux.

    All combinations of a few values of each option first, then steps from the best ones to
    neighbouring values of one option at a time, as long as that helps. Then each positive number goes to the
    top of the parabola through the best value and those beside it, which scatters less than the best value.
    Where control learns from telemetry, which takes much longer than a run, the estimator's options and the
    gain at which telemetry is taken are those that are best with the integrator, and only the control's own
    options are searched. All have the same turbulence and noise; realisations are those from
    `FIRST_TUNING_REALISATION` on, which are not scored.

    Parameters
    ----------
    method : Method
    configuration : LoopConfiguration
    search : Search
    slopes : mapping, optional
        Settings of the slopes with the integrator, of which only the loop gain is searched again, from the
        given one. Default: searched; for control that learns, first.
    advance : callable, optional
        Called with the number of frames simulated, after every run.

    Returns
    -------
    dict
        What `stored` reads.
    """
    if slopes is None and method.control != INTEGRATOR:
        slopes = stored(tune(with_integrator(method), configuration, search, None, advance)).choice
    search, tuned = _searched(method, configuration, search, slopes)
    if all(len(tunable.values) == 1 for tunable in tuned.values()):
        best = Tuned({name: tunable.values[0] for name, tunable in tuned.items()}, math.nan)
    else:
        best = _Trials(method, configuration, search, tuned, advance).best()
    return {"choice": np.asarray(to_json(best.choice)), "strehl": np.asarray(best.strehl)}


def _searched(
    method: Method, configuration: LoopConfiguration, search: Search, slopes: Choice | None
) -> tuple[Search, dict[str, Tunable]]:
    """Return the search and what it tunes where the settings of the slopes are known, or None."""
    tuned = tuned_values(method, configuration)
    if slopes is None:
        return search, tuned
    for name in tuned.keys() & slopes.keys():
        value = slopes[name]
        if name != LOOP_GAIN:
            tuned[name] = Tunable((value,), (value,))
        elif method.control == INTEGRATOR:
            tuned[name] = replace(tuned[name], first=tuned[name].nearest(value).first)
        else:
            tuned[name] = tuned[name].nearest(value)
    return replace(search, finalists=1), tuned


def with_integrator(method: Method) -> Method:
    """Return the method with the same slopes whose control need not learn."""
    return replace(method, control=INTEGRATOR)


def _is_scale(values: Sequence[object]) -> bool:
    """Return whether an option's values are positive numbers, between which it may be."""
    return all(isinstance(value, float) and value > 0 for value in values)


def smoothed(
    method: Method, stars: Sequence[LoopConfiguration], choices: Sequence[Choice]
) -> list[dict[str, Any]]:
    """Return the choices at several fluxes, with numbers among the options that are a power of the flux.

    The Strehl ratio hardly depends on an option near its best value, so that the best one of a few short runs
    scatters from flux to flux. The power law is the median line (Theil 1950) through all fluxes, within the
    values on offer. Loop gain, whole numbers and options that may be 0 stay as they are, and with fewer than
    three fluxes everything.
    """
    if len(stars) < _FEWEST_FLUXES:
        return [dict(choice) for choice in choices]
    tuned, declared = [tuned_values(method, star) for star in stars], method.estimator.declared()
    flux = np.log([star.photons for star in stars])
    results = [dict(choice) for choice in choices]
    for name in tuned[0].keys() & declared.keys():
        offered = [options[name].values for options in tuned]
        if declared[name].whole or not all(_is_scale(values) for values in offered):
            continue
        from scipy.stats import theilslopes  # slow to import

        line = theilslopes(np.log([choice[name] for choice in choices]), flux, method="joint")
        for choice, log_flux, values in zip(results, flux, offered, strict=True):
            value = float(np.clip(math.exp(line.intercept + line.slope * log_flux), min(values), max(values)))
            choice[name] = float(f"{value:.3g}")
    return results


def stored(result: Mapping[str, NDArray[np.generic]]) -> Tuned:
    """Return what `tune` found."""
    return Tuned(parse_json(str(result["choice"])), float(result["strehl"]))


def tuning_frames(
    method: Method, configuration: LoopConfiguration, search: Search, slopes: Choice | None = None
) -> int:
    """Return about how many frames `tune` simulates, with `slopes` for control that learns."""
    search, tuned = _searched(method, configuration, search, slopes)
    combinations = math.prod(len(tunable.first) for tunable in tuned.values())
    several = sum(len(tunable.values) > 1 for tunable in tuned.values())
    if several == 0:
        return 0
    climbs = min(search.climbs, search.finalists)
    looks = search.finalists + 2 * several * climbs * min(2, search.rounds) if search.rounds else 0
    simulated = combinations * search.coarse_frames + looks * search.frames * search.realisations
    return simulated + learning_frames(method, configuration)


def learning_frames(method: Method, configuration: LoopConfiguration) -> int:
    """Return about how many frames could be simulated while a method's control learns."""
    if method.control == INTEGRATOR:
        return 0
    return configuration.control.telemetry_frames + _LEARNING_FRAMES


class _Trials:
    """Strehl ratios of the settings that were looked at, among those that are tuned."""

    def __init__(
        self,
        method: Method,
        configuration: LoopConfiguration,
        search: Search,
        tuned: Mapping[str, Tunable],
        advance: Advance | None,
    ) -> None:
        self._method, self._configuration, self._search = method, configuration, search
        self._tuned, self._advance, self._frames = tuned, advance, 0
        self._strehl: dict[tuple[tuple[Any, ...], int, int], float] = {}

    def best(self) -> Tuned:
        """Return the best of the values that are tuned."""
        search, firsts = self._search, (tunable.first for tunable in self._tuned.values())
        coarse = [dict(zip(self._tuned, values, strict=True)) for values in itertools.product(*firsts)]
        ranked = sorted(coarse, key=lambda choice: -self._coarse(choice))
        best = choice = ranked[0]
        strehl = self._coarse
        if search.rounds:
            finalists = sorted(ranked[: search.finalists], key=self._fine, reverse=True)
            best = max(map(self._climbed, finalists[: search.climbs]), key=self._fine)
            choice, strehl = self._between(best), self._fine
        return Tuned(choice, strehl(best))

    def _coarse(self, choice: Choice) -> float:
        """Return the Strehl ratio in one short run."""
        return self._mean(choice, self._search.coarse_frames, 1)

    def _fine(self, choice: Choice) -> float:
        """Return the mean Strehl ratio of longer runs."""
        return self._mean(choice, self._search.frames, self._search.realisations)

    def _mean(self, choice: Choice, frames: int, realisations: int) -> float:
        key = tuple(choice.values()), frames, realisations
        if key not in self._strehl:
            run = {"frames": frames, "settle_frames": self._search.settle_frames}
            short = self._configuration.replace("run", **run)
            method = with_choice(self._method, short, choice)
            runs = range(FIRST_TUNING_REALISATION, FIRST_TUNING_REALISATION + realisations)
            strehl = [simulate_loop(short, [method], realisation=run).mean_strehl() for run in runs]
            self._strehl[key] = float(np.mean(strehl))
            self._frames += frames * realisations
            if self._advance is not None:
                self._advance(self._frames)
        return self._strehl[key]

    def _neighbours(self, choice: Choice) -> list[dict[str, Any]]:
        """Return the choices one step away in one option."""
        neighbours = []
        for name, tunable in self._tuned.items():
            index = tunable.values.index(choice[name])
            for step in (index - 1, index + 1):
                if 0 <= step < len(tunable.values):
                    neighbours.append({**choice, name: tunable.values[step]})
        return neighbours

    def _climbed(self, best: dict[str, Any]) -> dict[str, Any]:
        """Return where steps to the best neighbour end."""
        for _ in range(self._search.rounds):
            better = max(self._neighbours(best), key=self._fine, default=best)
            if self._fine(better) <= self._fine(best):
                break
            best = better
        return best

    def _between(self, best: Choice) -> dict[str, Any]:
        """Return a choice with positive numbers at the top of the parabola through their neighbours."""
        choice = dict(best)
        for name, tunable in self._tuned.items():
            near = [best, *(other for other in self._neighbours(best) if other[name] != best[name])]
            if len(near) < 3 or not _is_scale(tunable.values):
                continue
            strehl = [self._fine(other) for other in near]
            logarithms = np.log([other[name] for other in near])
            bend, slope, _ = np.polyfit(logarithms - logarithms[0], strehl, 2)
            if bend < 0:
                top = np.clip(logarithms[0] - slope / (2 * bend), logarithms.min(), logarithms.max())
                choice[name] = float(f"{math.exp(top):.3g}")
        return choice
