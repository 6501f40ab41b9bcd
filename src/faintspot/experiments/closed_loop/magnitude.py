"""Strehl ratio against the star's flux, for any list of methods, each tuned at every flux."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from faintspot.base.checks import numbers_between
from faintspot.base.config.tables import save_tables
from faintspot.base.errors import InputError
from faintspot.base.files import derived, write_atomically
from faintspot.base.json_text import parse_json
from faintspot.experiments.closed_loop.experiment import Experiment, checked_methods, with_flux
from faintspot.experiments.closed_loop.methods import default_methods, with_choice
from faintspot.experiments.closed_loop.results import MagnitudeResult
from faintspot.experiments.closed_loop.search import Search
from faintspot.experiments.closed_loop.verdict import equal_methods
from faintspot.experiments.running import WorkerPool
from faintspot.loop.simulation.configuration.configuration import LoopConfiguration
from faintspot.loop.simulation.methods import Method
from faintspot.loop.simulation.record import MAGNITUDE_FILE
from faintspot.loop.simulation.telescope.calibration import camera_calibration
from faintspot.slopes.estimators.base import Need
from faintspot.slopes.estimators.built_in.gravity import BrightestPixels
from faintspot.slopes.estimators.built_in.smoothed import Smoothed
from faintspot.slopes.estimators.built_in.total_variation import TotalVariation
from faintspot.slopes.estimators.built_in.window import Window
from faintspot.slopes.pipeline import configuration as configuration_file
from faintspot.slopes.spots.psf import PSF

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
