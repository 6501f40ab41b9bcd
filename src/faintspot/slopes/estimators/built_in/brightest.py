"""Brightest pixels: background subtraction and centre of gravity, without denoising."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from faintspot.slopes.estimators.base import Style
from faintspot.slopes.estimators.built_in.gravity import GravityPlan, KeepingBrightest
from faintspot.slopes.estimators.registry import register
from faintspot.slopes.estimators.sensor import Sensor


@register
@dataclass(frozen=True, eq=False, kw_only=True)
class BrightestPixels(KeepingBrightest):
    """Centre of gravity of the brightest pixels (Basden, Myers & Gendron 2012), without denoising."""

    name = "brightest"
    label = "brightest pixels"
    method = "brightest pixels, centre of gravity"
    cost = 0.21
    style = Style("#000000", "--", "o")
    automatic_method = "none"

    @classmethod
    def like(cls, other: KeepingBrightest) -> BrightestPixels:
        """Return an estimator with the background subtraction of `other` and no denoising."""
        return cls(**{name: getattr(other, name) for name in cls.declared()})

    def in_words(self, n_subapertures: int, pixels: int) -> str:
        """See `Estimator`."""
        return f"no denoising; {self.kept_in_words(n_subapertures, pixels)}"

    def denoised(self, images: NDArray[np.float32]) -> NDArray[np.float32]:
        """See `KeepingBrightest`."""
        return images

    def prepared(self, sensor: Sensor) -> GravityPlan:
        """See `Estimator`."""
        return GravityPlan(self, sensor)
