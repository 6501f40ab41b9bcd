"""Strehl ratio against the star's flux, for any list of methods, each tuned at every flux."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.checks import numbers_between
from faintspot.base.errors import InputError
from faintspot.base.files import derived, write_atomically
from faintspot.base.tables import save_tables
from faintspot.base.text_files import parse_json, to_json
from faintspot.experiments.closed_loop.results import (
    MagnitudeResult,
    default_methods,
    tuned_values,
    with_choice,
)
from faintspot.experiments.closed_loop.search import (
    QUICK,
    Search,
    Tuned,
    learning_frames,
    smoothed,
    stored,
    tune,
    tuning_frames,
    with_integrator,
)
from faintspot.experiments.closed_loop.verdict import equal_methods
from faintspot.experiments.methods import Choice
from faintspot.experiments.running import Advance, Unit, WorkerPool, in_stages, run_units
from faintspot.experiments.store import Arrays, UnitStore, ZarrStore, fingerprint_of
from faintspot.loop.control.base import INTEGRATOR
from faintspot.loop.simulation.configuration import LoopConfiguration
from faintspot.loop.simulation.methods import Method
from faintspot.loop.simulation.record import MAGNITUDE_FILE, make_folder
from faintspot.loop.simulation.simulation import simulate_loop
from faintspot.loop.simulation.telescope import camera_calibration
from faintspot.slopes.estimators.base import Need
from faintspot.slopes.estimators.built_in.gravity import BrightestPixels
from faintspot.slopes.estimators.built_in.smoothed import Smoothed
from faintspot.slopes.estimators.built_in.total_variation import TotalVariation
from faintspot.slopes.estimators.built_in.window import Window
from faintspot.slopes.pipeline import configuration as configuration_file
from faintspot.slopes.spots.psf import PSF

_QUICK_RUN = {"frames": 300, "settle_frames": 60, "realisations": 2}
_NO_LOSS = 0.02  # of Strehl ratio: the best one of many short runs is that much too high

Stars = Mapping[float, LoopConfiguration]
"""The loop with the star of each flux."""
Choices = dict[tuple[str, float], Choice]
"""Tuned values by the method's name and the flux."""


class Experiment:
    """A closed-loop experiment in a folder, where finished units are remembered.

    Parameters
    ----------
    name : str
        Beginning of the names of its stores.
    configuration, folder, quick, search, pool, overwrite
        As for `run_magnitude`.
    """

    def __init__(
        self,
        configuration: LoopConfiguration,
        folder: str | Path,
        name: str,
        quick: bool,
        search: Search | None,
        pool: WorkerPool | None,
        overwrite: bool,
    ) -> None:
        self.configuration = quick_run(configuration) if quick else configuration
        self.folder, self._name, self._overwrite = make_folder(folder), name, overwrite
        self._search = search or (QUICK if quick else Search())
        self._pool = pool or WorkerPool()

    def measured(self, kinds: Sequence[Method], fluxes: Sequence[float]) -> dict[str, NDArray[Any]]:
        """Tune every method at every flux, then score it.

        Slopes are tuned first, with the integrator, also of methods whose control learns: all their options
        at each flux alone, then the loop gain with smoothed options, which are kept where they lose nothing.
        Then what is the control's own.

        Parameters
        ----------
        kinds : sequence of Method
        fluxes : sequence of float
            Photo-electrons of a fully lit sub-aperture in a frame.

        Returns
        -------
        dict
            What `scored_runs` returns, (methods, fluxes, realisations), and "choices", (methods, fluxes):
            JSON text of the tuned values.
        """
        stars = {flux: with_flux(self.configuration, flux) for flux in fluxes}
        plain = list({kind.name: kind for kind in map(with_integrator, kinds)}.values())
        learning = [kind for kind in kinds if kind.control != INTEGRATOR]
        guess: Choices = {
            (kind.name, flux): {name: axis.first[0] for name, axis in tuned_values(kind, star).items()}
            for kind in plain
            for flux, star in stars.items()
        }
        expected = (
            self._tuning(plain, stars, {}),
            self._tuning(plain, stars, guess),
            self._tuning(learning, stars, guess),
            self._scoring(kinds, stars, {}),
        )
        sizes = [sum(unit.size for unit in units.values()) for units in expected]
        alone, again, control, scoring = in_stages(self._pool, sizes)
        choices = self._choices(plain, stars, alone, again)
        of_control = self._tuned("tuning of control", learning, stars, choices, control)
        choices |= {key: tuned.choice for key, tuned in of_control.items()}
        units = self._scoring(kinds, stars, choices)
        results = self._run("scoring", scored_runs, units, scoring)
        scored = [[results[units[kind.name, name].key] for name in stars] for kind in kinds]
        arrays = {
            name: np.array([[each[name] for each in row] for row in scored])
            for name in ("strehl", "centroid_gain", "settings")
        }
        texts = [[to_json(choices[kind.name, flux]) for flux in stars] for kind in kinds]
        return {**arrays, "choices": np.array(texts)}

    def _choices(
        self, plain: Sequence[Method], stars: Stars, alone: WorkerPool, again: WorkerPool
    ) -> Choices:
        """Return the tuned values of the slopes, tuned now where they are not stored."""
        first = self._tuned("tuning", plain, stars, {}, alone)
        best = {key: tuned.choice for key, tuned in first.items()}
        smooth: Choices = {}
        for kind in plain:
            choices = smoothed(kind, list(stars.values()), [best[kind.name, flux] for flux in stars])
            smooth |= {(kind.name, flux): choice for flux, choice in zip(stars, choices, strict=True)}
        if smooth != best:
            second = self._tuned("tuning of the loop gain", plain, stars, smooth, again)
            kept = {key: new for key, new in second.items() if new.strehl >= first[key].strehl - _NO_LOSS}
            best |= {key: tuned.choice for key, tuned in kept.items()}
        return best

    def _tuned(
        self, stage: str, kinds: Sequence[Method], stars: Stars, slopes: Choices, pool: WorkerPool
    ) -> dict[tuple[str, float], Tuned]:
        """Return the tuned values of every method with every star, given those of its slopes."""
        units = self._tuning(kinds, stars, slopes)
        if not units:
            return {}
        results = self._run(stage, tune, units, pool, "-tuning")
        return {key: stored(results[unit.key]) for key, unit in units.items()}

    def _tuning(
        self, kinds: Sequence[Method], stars: Stars, slopes: Choices
    ) -> dict[tuple[str, float], Unit]:
        units = {}
        for kind in kinds:
            for flux, star in stars.items():
                known = slopes.get((with_integrator(kind).name, flux))
                arguments = kind, star, self._search, known
                key = f"{kind.name}-{flux:g}{'' if known is None else f'-{_digest(known)}'}"
                units[kind.name, flux] = Unit(key, arguments, tuning_frames(*arguments))
        return units

    def _scoring(
        self, kinds: Sequence[Method], stars: Stars, choices: Choices
    ) -> dict[tuple[str, float], Unit]:
        run, units = self.configuration.run, {}
        for kind in kinds:
            size = run.realisations * run.frames + learning_frames(kind, self.configuration)
            for flux, star in stars.items():
                arguments = star, choices.get((kind.name, flux))
                key = f"{kind.name}-{flux:g}-{_digest(arguments)}"
                units[kind.name, flux] = Unit(key, (kind, *arguments), size)
        return units

    def _run(
        self,
        stage: str,
        function: Callable[..., Arrays],
        units: Mapping[tuple[str, float], Unit],
        pool: WorkerPool,
        suffix: str = "",
    ) -> UnitStore:
        """Run units that are kept in a store of the folder."""
        pool.say(stage)
        store = ZarrStore(
            make_folder(self.folder / "units") / f"{self._name}{suffix}.zarr",
            "closed-loop experiment",
            fingerprint_of(self.configuration.to_text(), str(asdict(self._search))),
            [unit.key for unit in units.values()],
            attributes={"name": self.configuration.name},
            overwrite=self._overwrite,
        )
        return run_units(function, list(units.values()), store, pool)


def _digest(value: object) -> str:
    """Return a short text that differs between choices."""
    return fingerprint_of(repr(value))[:8]


def scored_runs(
    kind: Method, star: LoopConfiguration, choice: Choice, advance: Advance
) -> dict[str, NDArray[np.generic]]:
    """Run a tuned method in all realisations of the turbulence, in one process: control learns only once.

    Returns
    -------
    dict
        Long-exposure Strehl ratio, centroid gain and settings as TOML, (realisations,).
    """
    method, frames, results = with_choice(kind, star, choice), star.run.frames, []
    for run in range(star.run.realisations):

        def progress(done: int, total: int, before: int = run * frames) -> None:
            advance(before + done)

        record = simulate_loop(star, [method], realisation=run, progress=progress)
        strehl = record.strehl[record.scored].mean()
        results.append((strehl, record.centroid_gain[0], record.method_settings[0]))
    names = "strehl", "centroid_gain", "settings"
    return {name: np.array(values) for name, values in zip(names, zip(*results, strict=True), strict=True)}


def with_flux(configuration: LoopConfiguration, photons: float) -> LoopConfiguration:
    """Return the configuration with another star."""
    return configuration.replace("camera", photons_per_subaperture=float(photons), magnitude=None)


def quick_run(configuration: LoopConfiguration) -> LoopConfiguration:
    """Return the configuration with few and short runs."""
    run = {name: min(value, getattr(configuration.run, name)) for name, value in _QUICK_RUN.items()}
    return configuration.replace("run", **run)


def checked_methods(names: Sequence[str]) -> list[Method]:
    """Return methods by their names, each once.

    Raises
    ------
    InputError
        For an unknown one, or none.
    """
    if not names:
        raise InputError("methods: expected at least one, got none")
    return list({kind.name: kind for kind in map(Method.named, names)}.values())


KIND = "magnitude"
QUICK_METHODS = tuple(kind.name for kind in (BrightestPixels, Smoothed, TotalVariation, Window))
_QUICK_FLUXES = 3


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
        Names, see `faintspot.loop.simulation.Method.named`. Default: `default_methods`; with `quick`, four.
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
    photons = photons if photons is not None else configuration.run.photons_per_subaperture
    fluxes = _checked_fluxes(photons, quick)
    experiment = Experiment(configuration, folder, KIND, quick, search, pool, overwrite)
    found = experiment.measured(kinds, fluxes)
    result = MagnitudeResult(
        tuple(kind.name for kind in kinds),
        tuple(kind.label for kind in kinds),
        np.array(fluxes),
        configuration.photometry.magnitude(fluxes),
        found["strehl"],
        found["centroid_gain"],
        found["settings"][:, :, 0],
        found["choices"],
        experiment.configuration.to_text(),
    )
    result.save(experiment.folder / MAGNITUDE_FILE)
    return result


def save_recommended(result: MagnitudeResult, configuration: LoopConfiguration, path: str | Path) -> Path:
    """Write what is recommended for the configuration's star into a configuration file.

    The PSF lies beside it; the table [loop] has control and loop gain, for people. The camera is written
    where the file has none. Beside it, NAME-loop.toml is the loop with this star and loop gain.

    Parameters
    ----------
    result : MagnitudeResult
        The measured flux nearest to that of the star counts.
    configuration : LoopConfiguration
    path : path

    Returns
    -------
    Path
        That of NAME-loop.toml.

    Raises
    ------
    InputError
        When nothing is measured yet, or a file cannot be written.
    """
    path, flux = Path(path), int(np.argmin(np.abs(np.log(result.photons / configuration.photons))))
    methods = equal_methods(result, flux)
    if not methods:
        raise InputError(f"{path}: expected a measured flux near {configuration.photons:g}, got none")
    best, star = methods[0], with_flux(configuration, float(result.photons[flux]))
    choice = parse_json(str(result.choices[best, flux]))
    method = with_choice(Method.named(result.names[best]), star, choice)
    settings, psf = method.settings, method.psf
    if settings.estimator.uses_flux:
        settings = settings.replace(flux_e=float(f"{star.photons:.4g}"))
    if psf is None and settings.estimator.needs & {Need.PSF, Need.WIDTH}:  # what the loop gives it
        psf = PSF.analytic(size=star.spot_width_px / 2, elongation=star.sensor.spot_elongation)
    for item in (settings, psf):
        if item is not None:
            configuration_file.save(path, item)
    if not configuration_file.has(path, "calibration"):
        configuration_file.save(path, camera_calibration(star))
    strehl = float(result.strehl[best, flux].mean())
    table = {"method": method.name, "control": method.control, "strehl": round(strehl, 4), **choice}
    save_tables(path, {"loop": table})
    loop = derived(path, "-loop.toml")
    gain = {} if method.gain is None else {"gain": method.gain}
    write_atomically(loop, star.replace("control", **gain).to_text())
    return loop


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
