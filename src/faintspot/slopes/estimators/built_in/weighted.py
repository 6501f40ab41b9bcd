"""Centre of gravity with a Gaussian weight centred on the spot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from faintspot.base.options import Value, option
from faintspot.base.tables import PRESETS
from faintspot.slopes.estimators import spot_tables
from faintspot.slopes.estimators.base import Need, Style
from faintspot.slopes.estimators.registry import register
from faintspot.slopes.estimators.sensor import Scene, Sensor
from faintspot.slopes.estimators.spot_tables import SpotModel
from faintspot.slopes.estimators.spots import SpotPlan, Stepping
from faintspot.slopes.kernels.spot_fits import fits as spot_fits

_WIDTHS = (1.0, 0.6, 0.8, 1.25, 1.6, 2.2)  # multiples of the spot's width


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
        high=64.0,
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
    usual_steps: ClassVar[Mapping[str, int]] = {"accurate": 8, "fast": 3}

    def tuned(self, scene: Scene) -> Mapping[str, Sequence[Any]]:
        """Return widths around that of the spot."""
        return {"weight_fwhm_px": [factor * scene.seen_fwhm_px for factor in _WIDTHS]}

    def prepared(self, sensor: Sensor) -> SpotPlan:
        """See `Estimator`."""
        return _WeightedPlan(self, sensor)


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
