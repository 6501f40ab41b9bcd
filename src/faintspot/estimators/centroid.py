"""The plain centre of gravity, of all the light in the window."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from faintspot.estimators.base import CALIBRATED, RAW, Step, Style
from faintspot.estimators.gravity import Gravity, GravityPrepared
from faintspot.estimators.registry import register
from faintspot.estimators.sensor import Sensor


@register
@dataclass(frozen=True, eq=False, kw_only=True)
class CentreOfGravity(Gravity):
    """Centre of gravity of the whole window, nothing subtracted."""

    name: ClassVar[str] = "centroid"
    label: ClassVar[str] = "centre of gravity"
    method: ClassVar[str] = "centre of gravity of the whole window"
    cost: ClassVar[float] = 0.13
    style: ClassVar[Style] = Style("#666666", ":", "x")
    steps_shown: ClassVar[tuple[Step, ...]] = (RAW, CALIBRATED)

    def prepared(self, sensor: Sensor) -> GravityPrepared:
        """See `Estimator`."""
        return GravityPrepared(self, sensor)
