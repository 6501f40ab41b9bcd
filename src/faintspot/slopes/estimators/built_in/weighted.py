"""Centre of gravity with a Gaussian weight; settings rows shared by estimators that know the spot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.options import Value, option
from faintspot.base.tables import PRESETS
from faintspot.slopes.estimators import spot_tables
from faintspot.slopes.estimators.base import Estimator, EstimatorPlan, Need, Style
from faintspot.slopes.estimators.registry import register
from faintspot.slopes.estimators.sensor import Scene
from faintspot.slopes.estimators.spot_tables import SpotModel
from faintspot.slopes.kernels.groups import RANGE
from faintspot.slopes.kernels.positions import fits as spot_fits
from faintspot.slopes.kernels.positions import spot_rows
from faintspot.slopes.kernels.positions.brightest import SMALLEST_VARIANCE

_STEPS_IN_BRIGHT_FLUX = 12


@dataclass(frozen=True, eq=False, kw_only=True)
class Stepping(Estimator):
    """Estimator that makes the same number of steps for every image, so that its run time is constant."""

    steps: int | None = option(None, "Number of steps.", low=1, high=100, whole=True, per_subaperture=False)

    usual_steps: ClassVar[Mapping[str, int]] = {"accurate": 3}
    """By preset."""

    @property
    def step_count(self) -> int:
        """Number of steps, given or default."""
        return int(self.steps or self.usual_steps[getattr(self, "preset", "accurate")])

    def for_bright_flux(self) -> Self:
        """Make more steps: without noise, the remaining influence of the starting point is a bias."""
        return self.replaced({"steps": max(self.step_count, _STEPS_IN_BRIGHT_FLUX)})

    def in_words(self, n_subapertures: int, pixels: int) -> str:
        """See `Estimator`."""
        own = [name for name in self.chosen() if name not in ("steps", "preset")]
        parts = [f"{name} {self._span(name, n_subapertures, pixels)}" for name in own]
        return f"{self.method or self.label} ({', '.join([*parts, f'{self.step_count} steps'])})"


_LEVEL = 0.05  # step of the logarithm of variances for which the flux of likely outliers is computed
_LARGEST_MOVE = 0.25  # in a step, in units of the FWHM; 1 px for narrow spots


class SpotPlan(EstimatorPlan):
    """Settings and tables of an estimator that uses profiles of spots, or of weights centred on them."""

    setting_rows = spot_fits.SETTING_ROWS
    rounds_electrons: Any = False
    """Whether images are rounded to whole electrons."""
    fits_background: Any = False
    """Whether a constant background is fitted along with the spot."""

    estimator: Stepping

    @cached_property
    def model(self) -> SpotModel:
        """Profiles of the spots or of the weights."""
        raise NotImplementedError

    @cached_property
    def taps(self) -> NDArray[np.float32]:
        """Taps of the smoothing in each sub-aperture, (n, 2, 1 + reach)."""
        return np.ascontiguousarray(self.model.taps[self.model.index])

    @property
    def model_tables(self) -> spot_rows.ModelTables:
        """Tables of the kernels that use a profile."""
        steps = self.estimator.step_count
        return spot_rows.ModelTables(
            steps, self.rounds_electrons, self.fits_background, self.taps, self.model.tables
        )

    @property
    def tables(self) -> spot_rows.ModelTables | spot_rows.PosteriorTables:
        """See `EstimatorPlan`."""
        return self.model_tables

    @cached_property
    def own_scratch(self) -> partial[spot_rows.SpotScratch]:
        """See `EstimatorPlan`."""
        return partial(spot_rows.spot_scratch, rank=self.model.rank, taps=self.taps.shape[2])

    def fill(self, table: NDArray[np.float32]) -> None:
        """See `EstimatorPlan`."""
        model, index = self.model, self.model.index
        table[spot_fits.MODEL] = index
        table[spot_fits.START_FLUX] = model.start_flux[index]
        table[spot_fits.GAIN_X], table[spot_fits.GAIN_Y] = model.gain[index].T
        narrow = model.fwhm_px.min(axis=1)[index]
        table[spot_fits.LARGEST_MOVE] = np.maximum(1.0, _LARGEST_MOVE * narrow)
        table[spot_fits.LEAST_FLUX] = self._least_flux(table[RANGE])

    def fill_flux(self, table: NDArray[np.float32], flux_e: Floats) -> None:
        """See `EstimatorPlan`."""
        table[spot_fits.FLUX] = np.nan_to_num(flux_e)

    def _least_flux(self, search_range_px: NDArray[np.float32]) -> Floats:
        """Return the flux of each sub-aperture below which outliers are expected."""
        sensor = self.sensor
        if sensor.psf is None:
            widths, index = np.unique(sensor.spot_fwhm_px, axis=0, return_inverse=True)
            spots, index = spot_tables.gaussian_psf(widths), index.reshape(-1)
        else:
            spots, index = self.psf, self.psf.index_of(sensor.n)
        variance = self.variance
        if sensor.has_noise_map:
            variance = np.exp(_LEVEL * np.rint(np.log(np.maximum(variance, SMALLEST_VARIANCE)) / _LEVEL))
        table: Floats = np.column_stack([index, search_range_px, variance])
        kinds, which = np.unique(table, axis=0, return_inverse=True)
        side = max(sensor.window)
        flux = [
            spot_tables.least_flux(spots, int(plane), float(level), sensor.excess_noise, float(reach), side)
            for plane, reach, level in kinds
        ]
        least: Floats = np.array(flux)[which.reshape(-1)]
        return least

    @cached_property
    def psf(self) -> Any:
        """PSF of the spots."""
        return self.sensor.psf


_WIDTHS = (1.0, 0.6, 0.8, 1.25, 1.6, 2.2)  # multiples of the spot's width


class _WeightedPlan(SpotPlan):
    """Profiles of the weights."""

    kernel = staticmethod(spot_fits.weighted_of_groups)

    @cached_property
    def model(self) -> SpotModel:
        """Profiles of the weights."""
        sensor = self.sensor
        spot = sensor.spot_fwhm_px
        factor = self.each("weight_fwhm_px") / np.sqrt(spot.prod(axis=1))
        weight = spot * np.where(np.isnan(factor), 1.0, factor)[:, None]
        return spot_tables.model_of_weights(weight, spot, sensor.psf, sensor.window, sensor.width)


@register
@dataclass(frozen=True, eq=False, kw_only=True)
class Weighted(Stepping):
    """Iteratively weighted centre of gravity (Fusco et al. 2004; Baker & Moallem 2007), gain corrected."""

    weight_fwhm_px: Value = option(
        None,
        "Full width at half maximum of the weight, geometric mean of both axes; the weight has the "
        "elongation of the spot. Default: the width of the spot.",
        unit="px",
        low=0.1,
        high=1e3,
    )
    preset: str = option(
        "accurate",
        'Number of steps if `steps` is not given: 8, or 3 with "fast".',
        choices=PRESETS,
        per_subaperture=False,
    )

    name = "weighted"
    label = "weighted centre of gravity"
    method = "centre of gravity with a Gaussian weight centred on the spot"
    needs = frozenset({Need.WIDTH})
    cost = 0.23
    style = Style("#009E73", "--", "^")
    plan = _WeightedPlan
    usual_steps: ClassVar[Mapping[str, int]] = {"accurate": 8, "fast": 3}

    def tuned(self, scene: Scene) -> Mapping[str, Sequence[Any]]:
        """Return widths around that of the spot."""
        return {"weight_fwhm_px": [factor * scene.seen_fwhm_px for factor in _WIDTHS]}
