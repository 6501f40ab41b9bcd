"""Quantities measured from telemetry."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from faintspot.loop.control.identification.layers import Identified
from faintspot.loop.turbulence.strength import OUTER_SCALE_M, TurbulenceStrength

Floats = NDArray[np.float64]

R0 = "r0 at 500 nm"
_WIND_ERROR = 0.35  # sub-apertures per second: measured slopes are not quite mean gradients in squares


@dataclass(frozen=True)
class Measured:
    """A quantity measured from telemetry."""

    name: str
    unit: str
    value: float = math.nan
    """Measured value; NaN if unknown."""
    error: float = math.nan
    """Standard error; NaN if unknown."""
    remark: str = ""
    """Reason why it is unknown, or assumptions of the value."""
    is_positive: bool = False
    """Whether negative values are impossible."""

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval; with small errors, or where only positive values occur, that of the logarithm."""
        if not self.value > 0 or (self.error > 0.5 * self.value and not self.is_positive):
            return self.value - 1.96 * self.error, self.value + 1.96 * self.error
        factor = math.exp(1.96 * self.error / self.value)
        return self.value / factor, self.value * factor

    def as_values(self) -> dict[str, object]:
        """Return plain values; the remark says why one is NaN."""
        low, high = self.interval
        numbers = {"value": self.value, "error": self.error, "low": low, "high": high}
        return {"name": self.name, "unit": self.unit, **numbers, "remark": self.remark}


@dataclass(frozen=True)
class Wind:
    """Layer of turbulence that the wind carries over the telescope."""

    speed: Measured
    direction: Measured
    """Towards which it moves, from +x (along columns) to +y (along rows)."""
    share: Measured

    @classmethod
    def of(cls, row: Iterable[float], speed_unit: str = "m/s") -> Self:
        """Return the layer of values and errors, as `row` gives them."""
        speed, speed_error, direction, direction_error, share, share_error = map(float, row)
        return cls(
            Measured("speed", speed_unit, speed, speed_error),
            Measured("direction", "degrees", direction, direction_error, "towards, from +x to +y"),
            Measured("share", "", share, share_error),
        )

    def row(self) -> list[float]:
        """Return speed, direction and share, each with its standard error."""
        values = self.speed, self.direction, self.share
        return [number for value in values for number in (value.value, value.error)]


def winds_of(identified: Identified) -> list[Wind]:
    """Return the layers of identified turbulence, the strongest first."""
    turbulence, errors = identified.turbulence, wind_errors(identified)
    layers = []
    for number in np.argsort(-turbulence.fraction):
        x, y = turbulence.wind_m_per_s[number]
        speed = max(math.hypot(x, y), 1e-9)
        along = float(np.hypot(*(errors[number] * (x, y)))) / speed
        across = float(np.hypot(*(errors[number] * (y, x)))) / speed
        direction = math.degrees(math.atan2(y, x)) % 360, math.degrees(across / speed)
        share = turbulence.fraction[number], identified.fraction_error[number]
        layers.append(Wind.of((speed, along, *direction, *share), f"{turbulence.length_unit}/s"))
    return layers


def wind_errors(identified: Identified) -> Floats:
    """Return standard errors (layers, 2) of winds, m/s, with those of the model."""
    return np.hypot(identified.wind_error_m_per_s, _WIND_ERROR * identified.turbulence.subaperture_m)


def outer_scale_and_r0(strength: TurbulenceStrength, known_scale_m: float | None = None) -> list[Measured]:
    """Return the outer scale, where it is known with this value, and r0."""
    remark = f"{OUTER_SCALE_M:g} m within a factor of two was expected" if known_scale_m is None else "given"
    name, unit = R0, "m"
    if not math.isfinite(strength.r0_m):
        outer = Measured("outer scale", "m", remark="unknown without r0")
        return [outer, Measured(name, unit, remark="the slopes vary no more than their noise")]
    outer = Measured("outer scale", "m", strength.outer_scale_m, strength.outer_scale_error_m, remark, True)
    return [outer, Measured(name, unit, strength.r0_m, strength.r0_error_m, is_positive=True)]
