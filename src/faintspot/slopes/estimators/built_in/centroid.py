"""Centre of gravity of the flux in the whole window."""

from __future__ import annotations

from dataclasses import dataclass

from faintspot.slopes.estimators.base import CALIBRATED, RAW, Style
from faintspot.slopes.estimators.built_in.gravity import Centroid, GravityPlan
from faintspot.slopes.estimators.registry import register
from faintspot.slopes.estimators.sensor import Sensor


@register
@dataclass(frozen=True, eq=False, kw_only=True)
class CentreOfGravity(Centroid):
    """Centre of gravity of the whole window, without background subtraction."""

    name = "centroid"
    label = "centre of gravity"
    method = "centre of gravity of the whole window"
    cost = 0.13
    style = Style("#666666", ":", "x")
    steps_shown = (RAW, CALIBRATED)

    def prepared(self, sensor: Sensor) -> GravityPlan:
        """See `Estimator`."""
        return GravityPlan(self, sensor)
