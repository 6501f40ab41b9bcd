"""Base class of the estimators that make a fixed number of steps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Self

from faintspot.base.config.options import option
from faintspot.slopes.estimators.base import Estimator

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
