"""Strehl ratio against the star's flux, for any list of methods, each tuned at every flux."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from faintspot.base.checks import numbers_between
from faintspot.base.errors import InputError
from faintspot.experiments.closed_loop.experiment import Experiment, checked_methods
from faintspot.experiments.closed_loop.methods import default_methods
from faintspot.experiments.closed_loop.results import MagnitudeResult
from faintspot.experiments.closed_loop.search import Search
from faintspot.experiments.running import WorkerPool
from faintspot.loop.simulation.configuration.configuration import LoopConfiguration
from faintspot.loop.simulation.files import MAGNITUDE_FILE
from faintspot.loop.simulation.simulation import DisabledErrors
from faintspot.slopes.estimators.built_in.brightest import BrightestPixels
from faintspot.slopes.estimators.built_in.smoothed import Smoothed
from faintspot.slopes.estimators.built_in.total_variation import TotalVariation
from faintspot.slopes.estimators.built_in.window import Window

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
        See `experiments.closed_loop.methods.method_kind`. Default: `default_methods`; with `quick`, four.
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
    found = experiment.measured(kinds, {f"{flux:g}": (flux, DisabledErrors()) for flux in fluxes})
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
