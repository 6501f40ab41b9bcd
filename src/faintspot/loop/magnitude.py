"""Strehl ratio against the star's light, for any list of arms, each tuned at every flux."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.checks import numbers_between
from faintspot.errors import InputError
from faintspot.loop.arms import arm_label, arm_named, default_arms
from faintspot.loop.configuration import LoopConfiguration
from faintspot.loop.results import MAGNITUDE_FILE, MagnitudeResult
from faintspot.loop.running import Advance, Unit, UnitStore, Workplace, run_units
from faintspot.loop.simulation import simulate_loop
from faintspot.loop.tuning import (
    QUICK,
    Search,
    stored_choice,
    tuning_frames,
    tuning_unit,
)

KIND = "magnitude"
QUICK_ARMS = ("brightest", "smoothed", "tv", "trained")
_QUICK_RUN = {"frames": 300, "settle_frames": 60, "realisations": 2}
_QUICK_FLUXES = 3

Results = Mapping[str, dict[str, NDArray[Any]]]


def run_magnitude(
    configuration: LoopConfiguration,
    folder: str | Path,
    arms: Sequence[str] | None = None,
    photons: Sequence[float] | None = None,
    *,
    quick: bool = False,
    search: Search | None = None,
    place: Workplace | None = None,
    overwrite: bool = False,
) -> MagnitudeResult:
    """Measure the Strehl ratio of arms against the star's light, or what is left of it.

    Each arm is tuned at each flux on air of its own, then scored on the configuration's number of
    realisations, which are the same for all. The result is also written to the folder.

    Parameters
    ----------
    configuration : LoopConfiguration
    folder : path
        Where finished units are remembered; made where it is not there.
    arms : sequence of str, optional
        Of `faintspot.loop.arms.ARM_NAMES`. Default: `default_arms`; with `quick`, four.
    photons : sequence of float, optional
        Photo-electrons of a fully lit sub-aperture in a frame. Default: the configuration's.
    quick : bool
        Few fluxes, short runs, a coarse search.
    search : Search, optional
        How settings are sought.
    place : Workplace, optional
        Where the work is done. Default: processes on this machine.
    overwrite : bool
        Whether another experiment in the folder is replaced.

    Raises
    ------
    InputError
        For unknown arms, no flux, or a folder that holds another experiment.
    MissingExtraError
        When HCIPy, or Dask where it is needed, is not installed.
    """
    place = Workplace() if place is None else place
    configuration = quick_run(configuration) if quick else configuration
    search = search or (QUICK if quick else Search())
    names = _checked_arms(arms if arms is not None else _default(configuration, quick))
    fluxes = _checked_fluxes(
        photons if photons is not None else configuration.run.photons_per_subaperture, quick
    )
    store = UnitStore(folder, KIND, f"{configuration.to_text()}\n{asdict(search)}", overwrite=overwrite)
    choices = tuned_choices(configuration, names, fluxes, search, store, place)
    units = [
        Unit(
            f"score-{name}-{flux:g}-{realisation}",
            (name, with_flux(configuration, flux), choice, realisation),
            configuration.run.frames,
        )
        for (name, flux), choice in choices.items()
        for realisation in range(configuration.run.realisations)
    ]
    place.say("scoring")
    result = _gathered(configuration, names, fluxes, choices, run_units(scored_run, units, store, place))
    result.save(store.folder / MAGNITUDE_FILE)
    return result


def tuned_choices(
    configuration: LoopConfiguration,
    names: Sequence[str],
    fluxes: Sequence[float],
    search: Search,
    store: UnitStore,
    place: Workplace,
) -> dict[tuple[str, float], dict[str, float]]:
    """Return the tuned values of every arm at every flux, tuned now where they are not stored."""
    units = {
        (name, flux): Unit(
            f"tune-{name}-{flux:g}",
            (name, with_flux(configuration, flux), search),
            tuning_frames(name, search),
        )
        for name in names
        for flux in fluxes
    }
    place.say("tuning")
    results = run_units(tuning_unit, list(units.values()), store, place)
    return {key: stored_choice(results[unit.key]) for key, unit in units.items()}


def scored_run(
    name: str,
    configuration: LoopConfiguration,
    choice: Mapping[str, float],
    realisation: int,
    advance: Advance,
) -> dict[str, NDArray[Any]]:
    """Return what one run of a tuned arm gives, as arrays that can be stored."""
    arm = arm_named(name, configuration, choice)
    record = simulate_loop(
        configuration, [arm], realisation=realisation, progress=lambda done, total: advance(done)
    )
    return {
        "strehl": np.asarray(record.mean_strehl()),
        "centroid_gain": record.centroid_gain[0],
        "psf": record.psf[0],
        "settings": np.asarray(record.arm_settings[0]),
    }


def with_flux(configuration: LoopConfiguration, photons: float) -> LoopConfiguration:
    """Return the configuration with another star."""
    return configuration.replace("camera", photons_per_subaperture=float(photons), magnitude=None)


def quick_run(configuration: LoopConfiguration) -> LoopConfiguration:
    """Return the configuration with few and short runs."""
    run = {name: min(value, getattr(configuration.run, name)) for name, value in _QUICK_RUN.items()}
    return configuration.replace("run", **run)


def _default(configuration: LoopConfiguration, quick: bool) -> tuple[str, ...]:
    names = default_arms(configuration)
    return tuple(name for name in names if name in QUICK_ARMS) if quick else names


def _checked_arms(arms: Sequence[str]) -> list[str]:
    names = list(dict.fromkeys(arms))
    if not names:
        raise InputError("arms: expected at least one, got none")
    for name in names:
        arm_label(name)  # refuses unknown ones
    return names


def _checked_fluxes(photons: Sequence[float], quick: bool) -> list[float]:
    fluxes = sorted(set(numbers_between("photons", photons, 0.0, 1e9, low_open=True).ravel().tolist()))
    if not fluxes:
        raise InputError("photons: expected at least one flux, got none: see run.photons_per_subaperture")
    if quick and len(fluxes) > _QUICK_FLUXES:
        chosen = np.linspace(0, len(fluxes) - 1, _QUICK_FLUXES).round().astype(int)
        return [fluxes[place] for place in chosen]
    return fluxes


def _gathered(
    configuration: LoopConfiguration,
    names: Sequence[str],
    fluxes: Sequence[float],
    choices: Mapping[tuple[str, float], Mapping[str, float]],
    results: Results,
) -> MagnitudeResult:
    runs = range(configuration.run.realisations)

    def of(variable: str, average: bool = False) -> NDArray[Any]:
        whole = np.array(
            [
                [[results[f"score-{name}-{flux:g}-{run}"][variable] for run in runs] for flux in fluxes]
                for name in names
            ]
        )
        return whole.mean(axis=2) if average else whole

    return MagnitudeResult(
        tuple(arm_label(name) for name in names),
        np.array(fluxes),
        configuration.photometry.magnitude(fluxes),
        of("strehl"),
        of("centroid_gain"),
        of("settings")[:, :, 0],
        np.array([[choices[name, flux]["gain"] for flux in fluxes] for name in names]),
        of("psf", average=True),
        configuration.to_text(),
    )
