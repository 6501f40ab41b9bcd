"""Strehl ratio against the star's flux, for any list of methods, each tuned at every flux."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.checks import numbers_between
from faintspot.base.errors import InputError
from faintspot.base.json_text import to_json
from faintspot.experiments.closed_loop.methods import Choice, MethodKind, default_methods, method_kind
from faintspot.experiments.closed_loop.results import MagnitudeResult
from faintspot.experiments.closed_loop.search import (
    QUICK,
    Search,
    Tuned,
    learning_frames,
    smoothed,
    stored,
    tuning_frames,
    tuning_unit,
    with_integrator,
)
from faintspot.experiments.running import Advance, Unit, WorkerPool, in_stages, run_units
from faintspot.experiments.store import Arrays, ZarrStore, fingerprint_of
from faintspot.loop.simulation.configuration.configuration import LoopConfiguration
from faintspot.loop.simulation.files import MAGNITUDE_FILE, make_folder
from faintspot.loop.simulation.simulation import simulate_loop
from faintspot.slopes.estimators.built_in.brightest import BrightestPixels
from faintspot.slopes.estimators.built_in.smoothed import Smoothed
from faintspot.slopes.estimators.built_in.total_variation import TotalVariation
from faintspot.slopes.estimators.built_in.trained import Trained
from faintspot.slopes.estimators.built_in.window import Window

KIND = "magnitude"
QUICK_METHODS = tuple(kind.name for kind in (BrightestPixels, Smoothed, TotalVariation, Window, Trained))
_QUICK_RUN = {"frames": 300, "settle_frames": 60, "realisations": 2}
_QUICK_FLUXES = 3
_NO_LOSS = 0.02  # of Strehl ratio: the best one of many short runs is that much too high


def run_magnitude(
    configuration: LoopConfiguration,
    folder: str | Path,
    methods: Sequence[str] | None = None,
    photons: Sequence[float] | None = None,
    *,
    quick: bool = False,
    search: Search | None = None,
    pool: WorkerPool | None = None,
    overwrite: bool = False,
) -> MagnitudeResult:
    """Measure the Strehl ratio of methods against the star's flux, or what is left of it.

    Each method is tuned at each flux in separate turbulence, then scored on the configuration's number of
    realisations, which are the same for all. Numbers among the options follow a power of the flux, see
    `smoothed`. The result is also written to the folder.

    Parameters
    ----------
    configuration : LoopConfiguration
    folder : path
        Where finished units are remembered; made where it is not there.
    methods : sequence of str, optional
        See `experiments.closed_loop.methods.method_kind`. Default: `default_methods`; with `quick`, five.
    photons : sequence of float, optional
        Photo-electrons of a fully lit sub-aperture in a frame. Default: the configuration's.
    quick : bool
        Few fluxes, short runs, a coarse search.
    search : Search, optional
        Search for the settings.
    pool : WorkerPool, optional
        Where the work is done. Default: processes on this machine.
    overwrite : bool
        Whether another experiment in the folder is replaced.

    Raises
    ------
    InputError
        For unknown methods, no flux, or a folder that holds another experiment.
    MissingExtraError
        When HCIPy is not installed.

    Examples
    --------
    >>> from faintspot.experiments import run_magnitude
    >>> from faintspot.loop.simulation import load_loop
    >>> result = run_magnitude(load_loop("canary"), "magnitude", quick=True)  # doctest: +SKIP
    """
    kinds = checked_methods(methods if methods is not None else _default(configuration, quick))
    experiment = Experiment.begun(configuration, folder, KIND, quick, search, pool, overwrite)
    configuration = experiment.configuration
    fluxes = _checked_fluxes(
        photons if photons is not None else configuration.run.photons_per_subaperture, quick
    )
    choices, array_of = experiment.measured(
        kinds,
        fluxes,
        scored_run,
        {f"{flux:g}": flux for flux in fluxes},
        lambda kind, flux, choice: (with_flux(configuration, flux), choice[flux]),
    )
    result = MagnitudeResult(
        tuple(kind.name for kind in kinds),
        tuple(kind.label for kind in kinds),
        np.array(fluxes),
        configuration.photometry.magnitude(fluxes),
        array_of("strehl"),
        array_of("centroid_gain"),
        array_of("settings")[:, :, 0],
        np.array([[to_json(choices[kind.name, flux]) for flux in fluxes] for kind in kinds]),
        configuration.to_text(),
    )
    result.save(experiment.folder / MAGNITUDE_FILE)
    return result


@dataclass(frozen=True)
class Experiment:
    """A closed-loop experiment: what is simulated, and where finished units are remembered."""

    configuration: LoopConfiguration
    plan: Any
    """Plan: a `Search`, or a dataclass of the experiment."""
    folder: Path
    name: str
    pool: WorkerPool
    overwrite: bool

    @classmethod
    def begun(
        cls,
        configuration: LoopConfiguration,
        folder: str | Path,
        name: str,
        quick: bool,
        search: Search | None,
        pool: WorkerPool | None,
        overwrite: bool,
    ) -> Experiment:
        """Return an experiment with a search, in a folder that is made where it is not there."""
        configuration = quick_run(configuration) if quick else configuration
        search = search or (QUICK if quick else Search())
        return cls(configuration, search, make_folder(folder), name, pool or WorkerPool(), overwrite)

    def store(self, units: Sequence[Unit], suffix: str = "") -> ZarrStore:
        """Return where units are kept.

        Raises
        ------
        InputError
            When the folder holds those of another experiment, or it cannot be written.
        """
        return ZarrStore(
            make_folder(self.folder / "units") / f"{self.name}{suffix}.zarr",
            "closed-loop experiment",
            fingerprint_of(self.configuration.to_text(), str(asdict(self.plan))),
            [unit.key for unit in units],
            attributes={"name": self.configuration.name},
            overwrite=self.overwrite,
        )

    def measured(
        self,
        kinds: Sequence[MethodKind],
        fluxes: Sequence[float],
        function: Callable[..., Arrays],
        columns: Mapping[str, Any],
        arguments: Callable[[MethodKind, Any, Mapping[float, Choice]], tuple[Any, ...]],
    ) -> tuple[dict[tuple[str, float], Choice], Callable[[str], NDArray[Any]]]:
        """Tune every method at every flux, then run every method, column and realisation.

        Parameters
        ----------
        kinds, fluxes : sequence
        function : callable
            Makes one run, given the method, `arguments`, the realisation and `advance`.
        columns : mapping
            Names and values of what the runs differ by.
        arguments : callable
            Takes the method, the column's value and the method's choices by flux.

        Returns
        -------
        dict, callable
            Tuned values by name and flux; and what gathers a variable of the runs, (methods, columns, runs).
        """
        stages = self._stages(kinds, fluxes, len(columns))
        choices = self._choices(kinds, fluxes, stages)
        run = self.configuration.run
        units = [
            self._scoring_unit(kind, name, function, arguments(kind, value, choice))
            for kind in kinds
            for choice in [{flux: choices[kind.name, flux] for flux in fluxes}]
            for name, value in columns.items()
        ]
        stages[-1].say("scoring")
        results = run_units(all_realisations, units, self.store(units), stages[-1])

        def gathered(variable: str) -> NDArray[Any]:
            values = np.array([results[unit.key][variable] for unit in units])
            return values.reshape(len(kinds), len(columns), run.realisations, *values.shape[2:])

        return choices, gathered

    def _choices(
        self, kinds: Sequence[MethodKind], fluxes: Sequence[float], stages: Sequence[WorkerPool]
    ) -> dict[tuple[str, float], Choice]:
        """Return the tuned values of every method at every flux, tuned now where they are not stored.

        Slopes first, with the integrator, also of methods whose control learns: all their options at each
        flux alone, then the loop gain with smoothed options, which are kept where they lose nothing. Then
        what is the control's own.
        """
        stars = {flux: with_flux(self.configuration, flux) for flux in fluxes}
        plain, learning = _plain_and_learning(kinds)
        first = self._tuned("tuning", plain, stars, {}, stages[0])
        best = {key: tuned.choice for key, tuned in first.items()}
        smooth: dict[tuple[str, float], Choice] = {
            (kind.name, flux): choice
            for kind in plain
            for chosen in [[best[kind.name, flux] for flux in fluxes]]
            for flux, choice in zip(fluxes, smoothed(kind, list(stars.values()), chosen), strict=True)
        }
        if smooth != best:
            again = self._tuned("tuning of the loop gain", plain, stars, smooth, stages[1])
            kept = {key: new for key, new in again.items() if new.strehl >= first[key].strehl - _NO_LOSS}
            best |= {key: tuned.choice for key, tuned in kept.items()}
        of_control = self._tuned("tuning of control", learning, stars, best, stages[2])
        return {**best, **{key: tuned.choice for key, tuned in of_control.items()}}

    def _tuned(
        self,
        stage: str,
        kinds: Sequence[MethodKind],
        stars: Mapping[float, LoopConfiguration],
        slopes: Mapping[tuple[str, float], Choice],
        pool: WorkerPool,
    ) -> dict[tuple[str, float], Tuned]:
        """Return the tuned values of every method with every star, given those of its slopes."""
        units = {
            (kind.name, flux): _tuning_unit(
                kind, star, self.plan, slopes.get((with_integrator(kind).name, flux))
            )
            for kind in kinds
            for flux, star in stars.items()
        }
        if not units:
            return {}
        pool.say(stage)
        store = self.store(list(units.values()), "-tuning")
        results = run_units(tuning_unit, list(units.values()), store, pool)
        return {key: stored(results[unit.key]) for key, unit in units.items()}

    def _stages(self, kinds: Sequence[MethodKind], fluxes: Sequence[float], columns: int) -> list[WorkerPool]:
        """Return where each stage runs, with a progress that is the whole experiment's."""
        star, (plain, learning) = with_flux(self.configuration, fluxes[0]), _plain_and_learning(kinds)
        slopes = {
            kind.name: {name: axis.first[0] for name, axis in kind.tuned(star).items()} for kind in plain
        }

        def tuning(kinds: Sequence[MethodKind], slopes: Mapping[str, Choice]) -> int:
            return len(fluxes) * sum(
                tuning_frames(kind, star, self.plan, slopes.get(with_integrator(kind).name)) for kind in kinds
            )

        run = self.configuration.run
        scoring = sum(learning_frames(kind, star) + run.realisations * run.frames for kind in kinds)
        sizes = tuning(plain, {}), tuning(plain, slopes), tuning(learning, slopes), columns * scoring
        return in_stages(self.pool, sizes)

    def _scoring_unit(
        self, kind: MethodKind, name: str, function: Callable[..., Arrays], arguments: tuple[Any, ...]
    ) -> Unit:
        run = self.configuration.run
        key = f"{kind.name}-{name}-{_digest(arguments)}"
        every = run.realisations, run.frames
        size = run.realisations * run.frames + learning_frames(kind, self.configuration)
        return Unit(key, (function, every, kind, *arguments), size)


def _plain_and_learning(kinds: Sequence[MethodKind]) -> tuple[list[MethodKind], list[MethodKind]]:
    """Return all methods with the integrator in place of their control, and those whose control learns."""
    plain = {kind.name: kind for kind in map(with_integrator, kinds)}
    return list(plain.values()), [kind for kind in kinds if kind.name not in plain]


def _tuning_unit(kind: MethodKind, star: LoopConfiguration, search: Search, slopes: Choice | None) -> Unit:
    key = f"{kind.name}-{star.camera.photons_per_subaperture:g}"
    if slopes is not None:
        key = f"{key}-{_digest(slopes)}"
    return Unit(key, (kind, star, search, slopes), tuning_frames(kind, star, search, slopes))


def _digest(value: object) -> str:
    """Return a short text that differs between choices."""
    return fingerprint_of(repr(value))[:8]


def all_realisations(
    function: Callable[..., Arrays], runs: tuple[int, int], *arguments: Any
) -> dict[str, NDArray[Any]]:
    """Make several runs in one process, where control learns only once; return their arrays, stacked.

    Parameters
    ----------
    function : callable
        Makes one run, given the arguments, the realisation and `advance`.
    runs : (int, int)
        Number of realisations, and frames of each run.
    *arguments
        The last one is `advance`.
    """
    count, frames = runs
    *constants, advance = arguments
    results = [
        function(*constants, run, lambda done, run=run: advance(run * frames + done)) for run in range(count)
    ]
    return {name: np.array([arrays[name] for arrays in results]) for name in results[0]}


def scored_run(
    kind: MethodKind, configuration: LoopConfiguration, choice: Choice, realisation: int, advance: Advance
) -> dict[str, NDArray[Any]]:
    """Return what one run of a tuned method gives, as arrays that can be stored."""
    method = kind.method(configuration, choice)
    record = simulate_loop(
        configuration, [method], realisation=realisation, progress=lambda done, total: advance(done)
    )
    return {
        "strehl": np.asarray(record.mean_strehl()),
        "centroid_gain": record.centroid_gain[0],
        "settings": np.asarray(record.method_settings[0]),
    }


def with_flux(configuration: LoopConfiguration, photons: float) -> LoopConfiguration:
    """Return the configuration with another star."""
    return configuration.replace("camera", photons_per_subaperture=float(photons), magnitude=None)


def quick_run(configuration: LoopConfiguration) -> LoopConfiguration:
    """Return the configuration with few and short runs."""
    run = {name: min(value, getattr(configuration.run, name)) for name, value in _QUICK_RUN.items()}
    return configuration.replace("run", **run)


def checked_methods(names: Sequence[str]) -> list[MethodKind]:
    """Return methods by their names, each once.

    Raises
    ------
    InputError
        For an unknown one, or none.
    """
    if not names:
        raise InputError("methods: expected at least one, got none")
    return list({kind.name: kind for kind in map(method_kind, names)}.values())


def _default(configuration: LoopConfiguration, quick: bool) -> list[str]:
    names = default_methods(configuration)
    return [name for name in names if name in QUICK_METHODS] if quick else names


def _checked_fluxes(photons: Sequence[float], quick: bool) -> list[float]:
    fluxes = sorted(set(numbers_between("photons", photons, 0.0, 1e9, low_open=True).ravel().tolist()))
    if not fluxes:
        raise InputError("photons: expected at least one flux, got none: see run.photons_per_subaperture")
    if quick and len(fluxes) > _QUICK_FLUXES:
        chosen = np.linspace(0, len(fluxes) - 1, _QUICK_FLUXES).round().astype(int)
        return [fluxes[index] for index in chosen]
    return fluxes
