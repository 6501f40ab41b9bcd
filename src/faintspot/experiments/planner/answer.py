"""The planner's answer: what to use, how good everything else is, and what this rests on."""

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from faintspot.base.arrays import Floats
from faintspot.base.errors import InputError
from faintspot.base.statistics import Estimate, SlopeStatistics
from faintspot.base.tables import save_tables
from faintspot.experiments.curves import Curve
from faintspot.experiments.methods import Knowledge
from faintspot.experiments.planner.promise import Promise
from faintspot.experiments.planner.question import Question
from faintspot.experiments.planner.stated import CAMERA
from faintspot.loop.simulation.methods import Method
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.pipeline import configuration
from faintspot.slopes.pipeline.settings import Settings
from faintspot.slopes.spots.psf import PSF


@dataclass(frozen=True, eq=False)
class MethodResult:
    """One method at the star's flux, with its best settings."""

    method: Method
    statistics: SlopeStatistics
    over_brightest: Estimate
    """Magnitudes of guide star gained over brightest pixels, by R."""
    over_thresholded: Estimate
    """The same over thresholding."""
    limiting_flux_e: Estimate | None = None
    """Flux at which R equals the budget: 0 below and infinity above all that was tried; None without one."""

    @property
    def settings(self) -> Settings:
        """The best settings."""
        return self.method.settings


@dataclass(frozen=True, eq=False)
class Answer:
    """Result of `faintspot.experiments.tune`."""

    question: Question
    curve: Curve
    """R of all methods at m fluxes, the settings chosen anew at each."""
    results: tuple[MethodResult, ...]
    equal: tuple[str, ...]
    """Names of the methods that are as good as the best within the errors; the first is recommended."""
    bound_px: Floats
    """(m,) R of an estimator at the Cramer-Rao bound, for spots without speckles."""
    realisations: int
    """Spots that were scored at each flux."""
    left_out: dict[str, str]
    """Methods that were not tried, and why."""
    promises: dict[str, Promise] = field(default_factory=dict)
    """Slope error of every method, checked on the recording; empty where there is none."""

    @property
    def flux_e(self) -> Floats:
        """(m,) fluxes of the curves; the star's is one of them."""
        return self.curve.flux_e

    @property
    def at_star(self) -> int:
        """Index of the star's flux."""
        return int(np.argmin(np.abs(np.log(self.flux_e / self.question.star_flux_e))))

    @property
    def best(self) -> MethodResult:
        """The recommended method."""
        return self[self.equal[0]]

    @property
    def promise(self) -> Promise | None:
        """The recommended method's slope error, checked on the recording."""
        return self.promises.get(self.best.method.name)

    @property
    def best_without_psf(self) -> MethodResult:
        """The best method of those that need not know the spot."""
        blind = [result for result in self.results if Knowledge.of(result.method.estimator) < Knowledge.SPOT]
        if self.best in blind:
            return self.best
        return min(blind, key=lambda result: result.statistics.ranking_rms)

    @property
    def prior_rms_px(self) -> float:
        """Rms per axis of the spots' positions, and so of always answering the reference."""
        return float(self.question.spots.search_range_px / math.sqrt(3))

    @property
    def is_hopeless(self) -> bool:
        """Whether even the recommended method's corrected rms is not below the spots' own motion."""
        return not self.best.statistics.corrected_rms.value < self.prior_rms_px

    @property
    def magnitude_label(self) -> str:
        """Name of the quantity in `magnitudes`."""
        photometry = self.question.photometry
        if photometry is None:
            return f"magnitudes fainter than the {self.question.subject}"
        return f"guide star magnitude ({photometry.band})"

    def magnitudes(self, flux_e: ArrayLike) -> Floats:
        """Return the magnitudes of stars of these fluxes; relative to the star without photometry."""
        photometry = self.question.photometry
        if photometry is not None:
            return photometry.magnitude(flux_e)
        return np.asarray(-2.5 * np.log10(np.asarray(flux_e) / self.question.star_flux_e))

    @property
    def calibration(self) -> Calibration:
        """The camera, with the maps that the question brought along."""
        question = self.question
        base = Calibration() if question.calibration is None else question.calibration
        stated: dict[str, Any] = {name: getattr(question, name) for name in CAMERA}
        if base.typical_read_noise_e == question.read_noise_e:
            stated["read_noise_e"] = base.read_noise_e
        return replace(base, **stated)

    def __getitem__(self, name: str) -> MethodResult:
        """Return the result of an estimator.

        Raises
        ------
        InputError
            For one that was not tried.
        """
        results = {result.method.name: result for result in self.results}
        result = results.get(name)
        if result is None:
            raise InputError(f"estimator {name!r}: expected one that was tried: {', '.join(results)}")
        return result

    @property
    def _psf(self) -> PSF | None:
        """PSF for the configuration; with a laser that of every sub-aperture, if their places are known."""
        question = self.question
        if question.laser is None:
            return self.best.method.psf
        if question.whole_layout is None or question.subaperture_m is None:
            return None
        optics = {name: getattr(question, name) for name in ("pixel_scale_arcsec", "subaperture_m")}
        star = question.laser.star_of(replace(question.whole_layout, **optics))
        return question.laser.psf(star, question.spots.shape)

    def save(self, path: str | Path) -> None:
        """Write the recommended settings as a configuration file; what else it holds stays.

        PSF and weights lie beside it, with a laser the PSF of every sub-aperture; the table [promise] says
        what the recording made of it, if any. Without a layout the file holds the other tables only.

        Raises
        ------
        InputError
            When the file cannot be written.
        """
        best = self.best
        for item in (
            self.question.whole_layout,
            best.settings,
            self.calibration,
            self._psf,
            best.method.weights,
        ):
            if item is not None:
                configuration.save(path, item)
        save_tables(path, {"promise": None if self.promise is None else self.promise.to_table()})


def settings_in_words(settings: Settings) -> str:
    """Return the settings that are not at their defaults as `name value` pairs."""
    pairs = [f'estimator "{settings.estimator.name}"']
    for name, value in settings.chosen().items():
        pairs.append(f'{name} "{value}"' if isinstance(value, str) else f"{name} {value:g}")
    return ", ".join(pairs)
