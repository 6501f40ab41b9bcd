"""Maximum a posteriori: likelihood with a prior on the position; the posterior's mean at very low light."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from faintspot.estimators import spot_tables
from faintspot.estimators.base import Style
from faintspot.estimators.maximum_likelihood import Likelihood, LikelihoodPrepared
from faintspot.estimators.registry import register
from faintspot.estimators.scene import Scene
from faintspot.estimators.sensor import Sensor
from faintspot.estimators.spot_tables import PosteriorGrid
from faintspot.kernels import located
from faintspot.kernels.groups import RANGE, light_above_edges
from faintspot.options import option
from faintspot.presets import PRESETS

Floats = NDArray[np.float64]


@register
@dataclass(frozen=True, eq=False, kw_only=True)
class MaximumAPosteriori(Likelihood):
    """Maximum likelihood with a prior whose mean is the reference, or what a loop predicts."""

    prior_std_px: Any = option(
        None,
        "Standard deviation of the prior. Default: none but the search range.",
        unit="px",
        low=1e-6,
        high=1e4,
    )
    preset: str = option(
        "accurate",
        'How many steps are made where their number is not given: 3, or with "fast" 2.',
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

    def for_scene(self, scene: Scene) -> Self:
        """Take the spread of positions that are uniform within their range."""
        return super().for_scene(scene).replaced({"prior_std_px": scene.position_range_px / math.sqrt(3)})

    def for_bright_light(self) -> MaximumAPosteriori:
        """Leave out the prior."""
        return self.replaced({"prior_std_px": None})

    def prepared(self, sensor: Sensor) -> LikelihoodPrepared:
        """See `Estimator`."""
        return _Prepared(self, sensor)


class _Prepared(LikelihoodPrepared):
    """Tables of the posterior, too, for every level of light that occurs."""

    kernel = staticmethod(located.posterior_of_groups)
    light_step = 1.1  # larger than others', as each level has its tables

    def __init__(self, estimator: MaximumAPosteriori, sensor: Sensor) -> None:
        super().__init__(estimator, sensor)
        self.needs_light = bool(np.isnan(sensor.flux_e).all())
        if self.fits_background:
            self.light_kernel = light_above_edges
        self._posteriors: list[PosteriorGrid] = []
        self._scratch: tuple[int, Any] = (-1, None)
        self._extent = 0.0

    @property
    def tables(self) -> Any:
        """See `Prepared`."""
        if len(self._posteriors) > 1:
            self._posteriors = [spot_tables.joined(self._posteriors)]
        found = self._posteriors[0] if self._posteriors else spot_tables.NO_POSTERIOR
        return located.PosteriorTables(
            self.model_tables, found.tables, found.constants, found.grid, found.spacing
        )

    @property
    def own_scratch(self) -> Any:
        """See `Prepared`."""
        positions = len(self.tables.grid)
        if self._scratch[0] != positions:
            make = partial(
                located.spot_scratch, rank=self.model.rank, taps=self.taps.shape[2], positions=positions
            )
            self._scratch = positions, make
        return self._scratch[1]

    def fill(self, table: NDArray[np.float32]) -> None:
        """See `Prepared`."""
        super().fill(table)
        table[located.PRIOR_WEIGHT] = np.nan_to_num(self.each("prior_std_px") ** -2.0)
        self._extent = float(np.abs(self.sensor.zero).max() + table[RANGE].max())

    def fill_light(self, table: NDArray[np.float32], flux_e: Floats) -> None:
        """See `Prepared`."""
        super().fill_light(table, flux_e)
        sensor, psf, floors = self.sensor, self.psf, self.each("weight_floor")
        planes = psf.index_of(sensor.n)
        kinds, which = np.unique(np.column_stack([planes, flux_e, floors]), axis=0, return_inverse=True)
        grid, spacing = spot_tables.posterior_grid(self._extent, float(psf.fwhm_px.min()), sensor.window)
        made = spot_tables.posterior_tables(
            psf,
            kinds[:, 0].astype(np.int64),
            kinds[:, 1],
            self.variance + kinds[:, 2] * kinds[:, 1],
            sensor.excess_noise,
            grid,
            spacing,
            sensor.window,
            sensor.width,
        )
        before = sum(len(part.tables) for part in self._posteriors)
        self._posteriors.append(made)
        table[located.KIND] = before + which.reshape(-1)
