"""Centre of gravity of the flux above a threshold."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.base.options import Value, option
from faintspot.slopes.estimators.base import Style
from faintspot.slopes.estimators.built_in.gravity import Centroid, Floats, GravityPlan
from faintspot.slopes.estimators.registry import register
from faintspot.slopes.estimators.sensor import Scene, Sensor
from faintspot.slopes.kernels.gravity import gravity

_OF_NOISE = (3.0, 1.5, 2.0, 2.5, 4.0, 5.0)  # multiples of the noise of a dark pixel
_OF_PEAK = (0.05, 0.1, 0.2, 0.3)  # for bright spots
_SMALLEST_E = 0.01


@register
@dataclass(frozen=True, eq=False, kw_only=True)
class Thresholded(Centroid):
    """Centre of gravity after subtracting a threshold from every pixel; negative pixels are set to 0."""

    threshold_e: Value = option(None, "Level subtracted from every pixel.", unit="e-", low=0.0, high=1e12)

    name = "thresholded"
    label = "thresholded centre of gravity"
    method = "centre of gravity of the flux above a threshold"
    cost = 0.15
    style = Style("#9a9a9a", ":", "X")

    def in_words(self, n_subapertures: int, pixels: int) -> str:
        """See `Estimator`."""
        return f"centre of gravity of the flux above {self._span('threshold_e', n_subapertures, pixels)} e-"

    def tuned(self, scene: Scene) -> Mapping[str, Sequence[object]]:
        """Return multiples of the noise of a dark pixel, and fractions of a typical spot's peak."""
        peak = scene.flux_e / (2.5 * scene.seen_fwhm_px**2)
        levels = [factor * scene.dark_noise_e for factor in _OF_NOISE] + [
            factor * peak for factor in _OF_PEAK
        ]
        return {"threshold_e": list(dict.fromkeys(max(float(f"{e:.3g}"), _SMALLEST_E) for e in levels))}

    def for_bright_flux(self) -> Thresholded:
        """Subtract nothing: a threshold for low flux does not suit high flux."""
        return self.replaced({"threshold_e": 0.0})

    def check(self, sensor: Sensor) -> None:
        """See `Estimator`."""
        if np.isnan(self.values("threshold_e", sensor.n, sensor.pixels).astype(float)).any():
            raise InputError(
                f"estimator.threshold_e: expected a level (electrons) for estimator {self.name!r}, got none"
            )

    def prepared(self, sensor: Sensor) -> GravityPlan:
        """See `Estimator`."""
        return _ThresholdedPlan(self, sensor)


class _ThresholdedPlan(GravityPlan):
    """Thresholds of a centre of gravity."""

    def fill_flux(self, table: NDArray[np.float32], flux_e: Floats) -> None:
        """See `EstimatorPlan`."""
        table[gravity.LEVEL], table[gravity.SUBTRACT] = self.each("threshold_e"), 1.0
