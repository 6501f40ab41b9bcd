"""The planner's answer for a closed loop: Strehl ratios, limiting magnitudes, and the sky that they open."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.config.tables import save_tables
from faintspot.base.errors import InputError
from faintspot.base.files import derived, write_atomically
from faintspot.base.json_text import parse_json
from faintspot.base.statistics import Estimate, paired_mean
from faintspot.experiments.closed_loop.experiment import with_flux
from faintspot.experiments.closed_loop.limits import Limit, falling, magnitude_gain, magnitude_limit
from faintspot.experiments.closed_loop.methods import LOOP_GAIN, NOISE_SCALE, MethodKind, method_kind
from faintspot.experiments.closed_loop.question import (
    BASELINE,
    MODEL_ERROR,
    PLACES,
    LoopQuestion,
    known_magnitudes,
    sky_coverage,
)
from faintspot.experiments.closed_loop.results import MagnitudeResult
from faintspot.experiments.methods import Knowledge
from faintspot.loop.control.identification.models import INTEGRATOR
from faintspot.loop.simulation.configuration.configuration import LoopConfiguration
from faintspot.loop.simulation.methods import Method
from faintspot.loop.simulation.telescope.camera import camera_calibration
from faintspot.slopes.estimators.base import Need
from faintspot.slopes.pipeline import configuration as configuration_file
from faintspot.slopes.spots.psf import PSF

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Coverage:
    """Fraction of a part of the sky that has a bright enough star."""

    fraction: float
    strehl_error: float
    """Error from that of the limiting magnitude."""
    model_error: float
    """Error from that of the star counts; the same for all methods."""
    bound: int
    """1: at least this fraction, as the limit is fainter than all that was measured; -1: at most."""


@dataclass(frozen=True, eq=False)
class LoopAnswer:
    """Result of `faintspot.experiments.tune_loop`.

    Examples
    --------
    >>> from faintspot.loop.simulation import load_loop
    >>> from faintspot.experiments import LoopQuestion, tune_loop
    >>> answer = tune_loop(LoopQuestion(load_loop("canary")), "loop-tune")  # doctest: +SKIP
    >>> answer.best.name  # doctest: +SKIP
    """

    question: LoopQuestion
    measured: MagnitudeResult
    """Strehl ratios and tuned values of all candidates with rising flux."""
    scored_frames: int
    """Number of scored frames of every run."""
    left_out: dict[str, str]
    """Candidates that were not tried, and why."""

    @cached_property
    def kinds(self) -> dict[str, MethodKind]:
        """Candidates that were tried, by name."""
        return {name: method_kind(name) for name in self.measured.names}

    @property
    def photons(self) -> Floats:
        """(F,), rising: photo-electrons of a fully lit sub-aperture in a frame."""
        return self.measured.photons

    @property
    def magnitudes(self) -> Floats:
        """(F,) of these stars."""
        return self.measured.magnitudes

    @property
    def at_star(self) -> int:
        """The measured flux of the configuration's star; the faintest one where it is not among them."""
        same = np.isclose(self.photons, self.question.configuration.photons, rtol=1e-3)
        return int(np.argmax(same)) if same.any() else 0

    @property
    def realisations(self) -> int:
        """Realisations of the turbulence that were scored."""
        return int(self.measured.strehl.shape[2])

    @property
    def level(self) -> float:
        """The Strehl ratio that limiting magnitudes are for."""
        strehl = self.question.strehl
        return float(0.5 * self.runs(BASELINE)[-1].mean()) if strehl is None else float(strehl)

    def runs(self, name: str) -> Floats:
        """Return a candidate's Strehl ratios (F, R).

        Raises
        ------
        InputError
            For one that was not tried.
        """
        runs: Floats = self.measured.strehl[self._index(name)]
        return runs

    def choice(self, name: str, flux: int) -> dict[str, Any]:
        """Return a candidate's tuned values at a measured flux."""
        choice: dict[str, Any] = parse_json(str(self.measured.choices[self._index(name), flux]))
        return choice

    def _index(self, name: str) -> int:
        names = self.measured.names
        if name not in names:
            raise InputError(f"method {name!r}: expected one that was tried: {', '.join(names)}")
        return names.index(name)

    def at_end(self, name: str, flux: int) -> list[str]:
        """Return which tuned values are the first or last that were on offer, but could be beyond."""
        kind, choice = self.kinds[name], self.choice(name, flux)
        declared = kind.estimator.declared()
        limited = []
        for option, tunable in kind.tuned(self.star(flux)).items():
            if len(tunable.values) < 2 or isinstance(choice[option], str):
                continue
            limits = (declared[option].low, declared[option].high) if option in declared else ()
            if choice[option] in (min(tunable.values), max(tunable.values)) and choice[option] not in limits:
                limited.append(option)
        return limited

    def strehl(self, name: str, flux: int) -> Estimate:
        """Return a method's Strehl ratio at a measured flux."""
        return paired_mean(self.runs(name)[flux])

    def difference(self, name: str, reference: str, flux: int) -> Estimate:
        """Return the difference of two methods' Strehl ratios in the same turbulence.

        Its interval holds for all comparisons with one method together.
        """
        differences = self.runs(name)[flux] - self.runs(reference)[flux]
        return paired_mean(differences, max(1, len(self.kinds) - 1))

    def equal(self, flux: int) -> tuple[str, ...]:
        """Return the methods that are not below the best beyond the error; the first is recommended.

        That is the baseline where it is among them, else the one that need not learn, has to know least and
        costs least.
        """
        best = max(self.kinds, key=lambda name: float(self.runs(name)[flux].mean()))
        same = [name for name in self.kinds if self.difference(best, name, flux).decided != 1]
        return tuple(sorted(same, key=lambda name: _simplicity(self.kinds[name])))

    @property
    def best(self) -> MethodKind:
        """Recommended method for the star."""
        return self.kinds[self.equal(self.at_star)[0]]

    def limit(self, name: str) -> Limit:
        """Return a method's limiting magnitude."""
        return magnitude_limit(self.magnitudes, self.runs(name), self.level)

    def gain(self, name: str, reference: str) -> Limit:
        """Return the gain in limiting magnitude over another method; NaN where one of them has no limit."""
        return magnitude_gain(self.magnitudes, self.runs(name), self.runs(reference), self.level)

    def coverage(self, name: str, place: str) -> Coverage | None:
        """Return what part of a place of `PLACES` a method can use; None: no radius."""
        limit, radius = self.limit(name), self.question.radius
        if radius is None:
            return None
        value = limit.magnitude.value
        ends = float(self.magnitudes[0]), float(self.magnitudes[-1])
        bound = 0 if limit.is_known else int(math.copysign(1, value))
        error = limit.error if limit.is_known else 0.0
        middle = value if limit.is_known else max(ends) if bound > 0 else min(ends)
        band = self.question.configuration.camera.band
        low, high = known_magnitudes(band)
        magnitudes = np.clip([middle, middle - error, middle + error], low, high)
        if not np.isfinite(magnitudes).all():  # too few realisations for an error
            magnitudes = np.clip([middle] * 3, low, high)
        fraction, less, more = sky_coverage(magnitudes, radius, PLACES[place], band)
        stars = -math.log1p(-min(float(fraction), 1 - 1e-12))
        few, many = (-math.expm1(-stars * (1 + sign * MODEL_ERROR)) for sign in (-1, 1))
        strehl_error = float(more - less) / 2 if math.isfinite(error) else math.nan
        return Coverage(float(fraction), strehl_error, (many - few) / 2, bound)

    def curve(self, name: str) -> Floats:
        """Return a method's mean Strehl ratios (F,), made to fall with magnitude; to be joined by lines."""
        return falling(self.runs(name)[::-1].mean(axis=1))[::-1]

    def star(self, flux: int) -> LoopConfiguration:
        """Return the loop with the star of a measured flux."""
        return with_flux(self.question.configuration, float(self.photons[flux]))

    def method(self, name: str, flux: int) -> Method:
        """Return a candidate with its settings for a measured flux, as `simulate_loop` takes it."""
        return self.kinds[name].method(self.star(flux), self.choice(name, flux))

    def save(self, path: str | Path) -> Path:
        """Write what is recommended for the star as a configuration file; what else it holds stays.

        PSF and score lie beside it; the table [loop] has control and loop gain, for people. The camera is
        written where the file has none. Beside it, NAME-loop.toml is the loop with this star and loop gain.

        Returns
        -------
        Path
            That of NAME-loop.toml.

        Raises
        ------
        InputError
            When a file cannot be written.
        """
        path, flux, best = Path(path), self.at_star, self.best
        method, star = self.method(best.name, flux), self.star(flux)
        settings = method.settings
        if settings.estimator.uses_flux:
            settings = settings.replace(flux_e=float(f"{star.photons:.4g}"))
        psf = method.psf
        if psf is None and settings.estimator.needs & {Need.PSF, Need.WIDTH}:  # what the loop gives it
            psf = PSF.analytic(size=star.spot_width_px / 2, elongation=star.sensor.spot_elongation)
        for item in (settings, psf, method.score):
            if item is not None:
                configuration_file.save(path, item)
        if not configuration_file.has(path, "calibration"):
            configuration_file.save(path, camera_calibration(star))
        save_tables(path, {"loop": self._loop_table(flux)})
        loop = derived(path, "-loop.toml")
        gain = {} if method.gain is None else {"gain": method.gain}
        write_atomically(loop, star.replace("control", **gain).to_text())
        return loop

    def _loop_table(self, flux: int) -> dict[str, object]:
        best = self.best
        strehl, choice = self.strehl(best.name, flux), self.choice(best.name, flux)
        table = {
            "method": best.name,
            "control": best.control,
            "gain": float(choice[LOOP_GAIN]),
            "photons_per_subaperture": float(self.photons[flux]),
            "strehl": round(strehl.value, 4),
        }
        if NOISE_SCALE in choice:
            table["noise_scale"] = float(choice[NOISE_SCALE])
        if self.method(best.name, flux).correct_gain:
            gains = self.measured.centroid_gain[self._index(best.name), flux]
            table["centroid_gain"] = round(float(gains.mean()), 3)
        if math.isfinite(strehl.standard_error):
            table["strehl_error"] = round(strehl.standard_error, 4)
        return table


def _simplicity(kind: MethodKind) -> tuple[object, ...]:
    beyond_baseline = kind.name != BASELINE, kind.control != INTEGRATOR
    return *beyond_baseline, int(Knowledge.of(kind.estimator)), kind.estimator.cost, kind.name
