"""Quantities measured from telemetry."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from faintspot.loop.turbulence.strength import OUTER_SCALE_M, Strength


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

    def as_values(self) -> dict[str, Any]:
        """Return plain values, for JSON; None if unknown."""
        low, high = self.interval
        numbers = {"value": self.value, "error": self.error, "low": low, "high": high}
        plain = {name: value if math.isfinite(value) else None for name, value in numbers.items()}
        return {"name": self.name, "unit": self.unit, **plain, "remark": self.remark}


def outer_scale_and_r0(strength: Strength, known_scale_m: float | None = None) -> list[Measured]:
    """Return the outer scale, where it is known with this value, and r0."""
    remark = f"{OUTER_SCALE_M:g} m within a factor of two was expected" if known_scale_m is None else "given"
    name, unit = "r0 at 500 nm", "m"
    if not math.isfinite(strength.r0_m):
        outer = Measured("outer scale", "m", remark="unknown without r0")
        return [outer, Measured(name, unit, remark="the slopes vary no more than their noise")]
    outer = Measured("outer scale", "m", strength.outer_scale_m, strength.outer_scale_error_m, remark, True)
    return [outer, Measured(name, unit, strength.r0_m, strength.r0_error_m, is_positive=True)]
