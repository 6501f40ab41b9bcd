"""Maximum likelihood for Poisson and Gaussian noise, and maximum a posteriori."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from types import MappingProxyType
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.checks import not_none
from faintspot.base.files import MOST_NUMBERS, check_size
from faintspot.base.options import Value, option
from faintspot.base.tables import PRESETS
from faintspot.slopes.estimators import spot_tables
from faintspot.slopes.estimators.base import Need, Style
from faintspot.slopes.estimators.built_in.weighted import SpotPlan, Stepping
from faintspot.slopes.estimators.registry import register
from faintspot.slopes.estimators.sensor import Scene, Sensor
from faintspot.slopes.estimators.spot_tables import SpotModel, model_of_psf
from faintspot.slopes.kernels.groups import RANGE, flux_above_edges
from faintspot.slopes.kernels.positions import fits as spot_fits
from faintspot.slopes.kernels.positions import spot_rows
from faintspot.slopes.spots.psf import PSF

_BLURS = (0.4, 0.0, 0.8, 1.2)  # of the PSF of a speckled spot, in units of lambda / d
_MODEL_ERRORS = (0.3, 0.0, 1.0)  # for speckled spots
_LEARNT_WEIGHT_FLOOR = 1e-3


@dataclass(frozen=True, eq=False, kw_only=True)
class Likelihood(Stepping):
    """Fit of the PSF to the image, whose weights follow from the noise."""

    blur_px: Any = option(
        0.0,
        "Standard deviation of the Gaussian blur applied to the PSF, for broadening by turbulence.",
        unit="px",
        low=0.0,
        high=16.0,
        per_subaperture=False,
    )
    local_background: str = option(
        "auto",
        "Fit a constant background in every sub-aperture along with the spot, for an unknown dark level or "
        'sky. "auto": fit it if the calibration gives no dark, or only a rough one.',
        choices=("auto", "on", "off"),
        per_subaperture=False,
    )
    model_error: Value = option(
        0.0,
        "Deviation of the spots from the PSF, as a fraction of each pixel's flux; it limits the weight of "
        "bright pixels. 0.1 to 0.5 for speckled spots. Values above sqrt(300 e- / flux) are reduced to it.",
        low=0.0,
        high=10.0,
    )
    weight_floor: Value = option(
        2e-4,
        "Variance, as a fraction of the flux, added to the variance of every pixel, so that small errors "
        "of the PSF in dark wings do not get large weights.",
        low=0.0,
        high=1.0,
    )

    needs = frozenset({Need.PSF, Need.READ_NOISE})

    def for_scene(self, scene: Scene) -> Self:
        """Reduce the weight of the wings of a learnt PSF."""
        return self.replaced({"weight_floor": _LEARNT_WEIGHT_FLOOR}) if scene.learnt else self

    def for_bright_flux(self) -> Self:
        """Keep the number of steps: more would follow the weights of high flux."""
        return self

    def tuned(self, scene: Scene) -> Mapping[str, Sequence[object]]:
        """Return blurs of the PSF and model errors to try for speckled spots."""
        if not scene.d_over_r0:
            return {}
        blurs = [factor * scene.lambda_over_d_px for factor in _BLURS]
        return {"blur_px": blurs, "model_error": list(_MODEL_ERRORS)}


class LikelihoodPlan(SpotPlan):
    """Tables of a weighted fit; pixels with low read noise are rounded to whole electrons."""

    kernel = staticmethod(spot_fits.fitted_of_groups)
    rows_of_options: Mapping[str, int] = MappingProxyType({"model_error": spot_fits.MODEL_ERROR})

    estimator: Likelihood

    def __init__(self, estimator: Likelihood, sensor: Sensor) -> None:
        super().__init__(estimator, sensor)
        if self.rounds_electrons:
            noise = sensor.pixel_noise_e
            rounded = noise < spot_fits.WHOLE_ELECTRONS_BELOW
            self.pixel_variance = np.where(rounded, _rounding_variance(noise), self.pixel_variance)

    @cached_property
    def model(self) -> SpotModel:
        """Profiles of the spots."""
        sensor = self.sensor
        return model_of_psf(self.psf, sensor.n, sensor.window, sensor.width, self.fits_background)

    @cached_property
    def psf(self) -> PSF:
        """PSF of the sensor, blurred if the estimator requires it."""
        psf, blur = not_none(self.sensor.psf), self.estimator.blur_px
        return psf.blurred(float(blur)) if blur > 0 else psf

    @cached_property
    def fits_background(self) -> bool:
        """See `SpotPlan`."""
        choice = self.estimator.local_background
        return choice == "on" or (choice == "auto" and not self.sensor.calibration.dark_is_known)

    @property
    def rounds_electrons(self) -> bool:
        """See `SpotPlan`."""
        camera = self.sensor.calibration
        known = camera.read_noise_e is not None
        low = known and bool(np.any(self.sensor.pixel_noise_e < spot_fits.WHOLE_ELECTRONS_BELOW))
        whole = camera.em_gain == 1 and camera.background_e == 0 and not self.fits_background
        return low and whole

    def fill(self, table: NDArray[np.float32]) -> None:
        """See `EstimatorPlan`."""
        super().fill(table)
        table[spot_fits.WEIGHT_FLOOR] = self.each("weight_floor")
        table[spot_fits.WEIGHT_EXCESS] = self.sensor.excess_noise
        table[spot_fits.MODEL_ERROR] = self.each("model_error")


@np.vectorize
def _rounding_variance(noise_e: float) -> float:
    """Return the variance after rounding: one electron more or less where the noise exceeds one half."""
    return math.erfc(0.5 / (noise_e * math.sqrt(2.0))) if noise_e > 0 else 0.0


@register
@dataclass(frozen=True, eq=False, kw_only=True)
class MaximumLikelihood(Likelihood):
    """Position and flux of maximum likelihood, by Fisher scoring."""

    name = "ml"
    label = "maximum likelihood"
    method = "maximum likelihood for Poisson and Gaussian noise"
    cost = 0.27
    style = Style("#0072B2", "-", "P")
    plan = LikelihoodPlan


# Levels of measured flux, a tenth apart, for which memory must suffice: a factor of two. Fluxes beyond the
# levels that fit use the tables of the nearest one.
_LEVELS = 8


class _MaximumAPosterioriPlan(LikelihoodPlan):
    """Tables of the fit and of the posterior for each level of flux."""

    kernel = staticmethod(spot_fits.posterior_of_groups)
    prior_weight_row = spot_fits.PRIOR_WEIGHT
    flux_step = 1.1  # larger than for other estimators, as each level needs its own tables

    def __init__(self, estimator: MaximumAPosteriori, sensor: Sensor) -> None:
        super().__init__(estimator, sensor)
        self.needs_flux = bool(np.isnan(sensor.flux_e).all())
        if self.fits_background:
            self.flux_kernel = flux_above_edges
        self._parts: list[tuple[NDArray[np.float32], NDArray[np.float32]]] = []
        self._levels: dict[float, int] = {}  # first table of each level of flux measured so far
        self._grid, self._spacing = np.zeros((0, 2), np.float32), 0.0
        self.table_shape = (0, 0, 0)
        """Shape of the table of each kind of sub-aperture: positions, rows, columns."""

    @property
    def tables(self) -> spot_rows.PosteriorTables:
        """See `EstimatorPlan`."""
        logarithms, constants = (np.concatenate(parts) for parts in zip(*self._parts, strict=True))
        self._parts = [(logarithms, constants)]
        return spot_rows.PosteriorTables(self.model_tables, logarithms, constants, self._grid, self._spacing)

    @cached_property
    def own_scratch(self) -> partial[spot_rows.SpotScratch]:
        """See `EstimatorPlan`."""
        return partial(super().own_scratch, positions=len(self._grid))

    def fill(self, table: NDArray[np.float32]) -> None:
        """See `EstimatorPlan`."""
        super().fill(table)
        table[spot_fits.PRIOR_WEIGHT] = np.nan_to_num(self.each("prior_std_px") ** -2.0)
        sensor = self.sensor
        reach = float(np.abs(sensor.zero).max() + table[RANGE].max())
        self._grid, self._spacing = spot_tables.posterior_grid(
            reach, float(self.psf.fwhm_px.min()), sensor.window
        )
        self.table_shape = spot_tables.posterior_shape(len(self._grid), sensor.window, sensor.width)
        flux = np.zeros(sensor.n) if self.needs_flux else sensor.flux_e
        kinds = len(self._kinds(flux)[0]) * (_LEVELS if self.needs_flux else 1)
        check_size(
            "map: tables of the posterior (kinds, positions, rows, columns)",
            (kinds, *self.table_shape),
            hint="give search_range_px, smaller windows, or one flux_e for all",
        )

    def fill_flux(self, table: NDArray[np.float32], flux_e: Floats) -> None:
        """See `EstimatorPlan`."""
        super().fill_flux(table, flux_e)
        sensor = self.sensor
        kinds, which = self._kinds(flux_e)
        before = sum(len(logarithms) for logarithms, _ in self._parts)
        if self._levels and (before + len(kinds)) * math.prod(self.table_shape) > MOST_NUMBERS:
            nearest = min(self._levels, key=lambda level: abs(math.log(level / flux_e[0])))
            table[spot_fits.KIND] = self._levels[nearest] + which
            return
        if self.needs_flux:
            self._levels[float(flux_e[0])] = before
        made = spot_tables.posterior_tables(
            self.psf,
            kinds[:, 0].astype(np.int64),
            kinds[:, 1],
            self.pixel_variance[kinds[:, 3].astype(np.int64)] + (kinds[:, 2] * kinds[:, 1])[:, None, None],
            sensor.excess_noise,
            self._grid,
            sensor.window,
            sensor.width,
        )
        self._parts.append(made)
        table[spot_fits.KIND] = before + which

    def _kinds(self, flux_e: Floats) -> tuple[Floats, NDArray[np.int64]]:
        """Return PSF, flux, floor and index of the noise of each kind, (n_kinds, 4), and each one's kind."""
        sensor = self.sensor
        noise = np.arange(sensor.n) * sensor.has_noise_map
        columns = [self.psf.index_of(sensor.n), flux_e, self.each("weight_floor"), noise]
        kinds, which = np.unique(np.column_stack(columns), axis=0, return_inverse=True)
        return kinds, which.reshape(-1)


@register
@dataclass(frozen=True, eq=False, kw_only=True)
class MaximumAPosteriori(Likelihood):
    """Maximum likelihood with a prior centred on the reference position or on the predicted slope."""

    prior_std_px: Value = option(
        None,
        "Standard deviation of the prior on the position. Default: no prior other than the search range.",
        unit="px",
        low=1e-6,
        high=1e4,
    )
    preset: str = option(
        "accurate",
        'Number of steps if `steps` is not given: 3, or 2 with "fast".',
        choices=PRESETS,
        per_subaperture=False,
    )

    name = "map"
    label = "maximum a posteriori"
    method = "maximum likelihood with a prior on the position"
    cost = 0.6
    style = Style("#56B4E9", "-", "*")
    plan = _MaximumAPosterioriPlan
    takes_prior = True
    usual_steps: ClassVar[Mapping[str, int]] = {"accurate": 3, "fast": 2}

    @property
    def uses_flux(self) -> bool:
        """See `Estimator`."""
        return True

    def for_scene(self, scene: Scene) -> Self:
        """Set the prior to the standard deviation of positions distributed uniformly within their range."""
        return super().for_scene(scene).replaced({"prior_std_px": scene.position_range_px / math.sqrt(3)})

    def for_bright_flux(self) -> Self:
        """Remove the prior."""
        return super().for_bright_flux().replaced({"prior_std_px": None})
