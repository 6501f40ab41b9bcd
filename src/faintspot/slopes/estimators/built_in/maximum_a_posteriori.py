"""Maximum a posteriori: likelihood with a prior on the position; posterior mean at very low flux."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from faintspot.base.config.options import Value, option
from faintspot.base.config.tables import PRESETS
from faintspot.base.sizes import MOST_NUMBERS, check_size
from faintspot.slopes.estimators import spot_tables
from faintspot.slopes.estimators.base import Style
from faintspot.slopes.estimators.built_in.maximum_likelihood import Likelihood, LikelihoodPlan
from faintspot.slopes.estimators.registry import register
from faintspot.slopes.estimators.scene import Scene
from faintspot.slopes.estimators.sensor import Sensor
from faintspot.slopes.estimators.spot_tables import NO_POSTERIOR, PosteriorGrid
from faintspot.slopes.kernels.driver.groups import RANGE, flux_above_edges
from faintspot.slopes.kernels.spot_fits import fits as spot_fits

Floats = NDArray[np.float64]

# Levels of measured flux, a tenth apart, for which memory must suffice: a factor of two. Fluxes beyond the
# levels that fit use the tables of the nearest one.
_LEVELS = 8


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

    def prepared(self, sensor: Sensor) -> LikelihoodPlan:
        """See `Estimator`."""
        return _MaximumAPosterioriPlan(self, sensor)


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
        self._posteriors: list[PosteriorGrid] = []
        self._levels: dict[float, int] = {}  # first table of each level of flux measured so far
        self._scratch = (-1, partial(spot_fits.spot_scratch))
        self._grid, self._spacing = NO_POSTERIOR.grid, NO_POSTERIOR.spacing
        self.table_shape = (0, 0, 0)
        """Shape of the table of each kind of sub-aperture: positions, rows, columns."""

    @property
    def tables(self) -> spot_fits.PosteriorTables:
        """See `EstimatorPlan`."""
        if len(self._posteriors) > 1:
            self._posteriors = [spot_tables.joined(self._posteriors)]
        found = self._posteriors[0] if self._posteriors else NO_POSTERIOR
        return spot_fits.PosteriorTables(
            self.model_tables, found.tables, found.constants, found.grid, found.spacing
        )

    @property
    def own_scratch(self) -> partial[spot_fits.SpotScratch]:
        """See `EstimatorPlan`."""
        positions = len(self.tables.grid)
        if self._scratch[0] != positions:
            make = partial(
                spot_fits.spot_scratch, rank=self.model.rank, taps=self.taps.shape[2], positions=positions
            )
            self._scratch = positions, make
        return self._scratch[1]

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
        before = sum(len(part.tables) for part in self._posteriors)
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
            (self._grid, self._spacing),
            sensor.window,
            sensor.width,
        )
        self._posteriors.append(made)
        table[spot_fits.KIND] = before + which

    def _kinds(self, flux_e: Floats) -> tuple[Floats, NDArray[np.int64]]:
        """Return PSF, flux, floor and index of the noise of each kind, (n_kinds, 4), and each one's kind."""
        sensor = self.sensor
        noise = np.arange(sensor.n) * sensor.has_noise_map
        columns = [self.psf.index_of(sensor.n), flux_e, self.each("weight_floor"), noise]
        kinds, which = np.unique(np.column_stack(columns), axis=0, return_inverse=True)
        return kinds, which.reshape(-1)
