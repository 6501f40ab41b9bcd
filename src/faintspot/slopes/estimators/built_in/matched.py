"""Matched filter: least-squares fit of the PSF."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from faintspot.base.config.options import Value, option
from faintspot.slopes.estimators.base import Need, Style
from faintspot.slopes.estimators.registry import register
from faintspot.slopes.estimators.scene import Scene
from faintspot.slopes.estimators.sensor import Sensor
from faintspot.slopes.estimators.spots import BLURS, PSFPlan, Stepping
from faintspot.slopes.kernels.spot_fits import fits as spot_fits


@dataclass(frozen=True, eq=False, kw_only=True)
class Fitted(Stepping):
    """Fit of the PSF to the image."""

    blur_px: Value = option(
        0.0,
        "Standard deviation of the Gaussian blur applied to the PSF, for broadening by turbulence.",
        unit="px",
        low=0.0,
        high=16.0,
        per_subaperture=False,
    )
    local_background: str = option(
        "auto",
        "Fit a constant background in every sub-aperture along with the spot, for an unknown dark level or "
        'sky. "auto": fit it if the calibration gives no dark, or only a rough one.',
        choices=("auto", "on", "off"),
        per_subaperture=False,
    )

    needs = frozenset({Need.PSF})

    def tuned(self, scene: Scene) -> Mapping[str, Sequence[object]]:
        """Return blurs to try for speckled spots."""
        if not scene.d_over_r0:
            return {}
        return {"blur_px": [factor * scene.lambda_over_d_px for factor in BLURS]}


@register
@dataclass(frozen=True, eq=False, kw_only=True)
class Matched(Fitted):
    """Matched filter: least-squares fit of position and flux.

    All pixels are weighted equally, or with a map of the read noise by it and the spot's mean photon noise.
    """

    name = "matched"
    label = "matched filter"
    method = "matched filter, least squares with the PSF"
    cost = 0.26
    style = Style("#CC79A7", "--", "v")

    def prepared(self, sensor: Sensor) -> PSFPlan:
        """See `Estimator`."""
        return _MatchedPlan(self, sensor)


class _MatchedPlan(PSFPlan):
    """Weights that differ only by the read noise, so that the filter stays linear in the image."""

    def fill(self, table: NDArray[np.float32]) -> None:
        """See `EstimatorPlan`."""
        super().fill(table)
        sensor = self.sensor
        if sensor.has_noise_map:
            planes = np.arange(len(self.psf.samples))
            spots = self.psf.images(np.zeros((len(planes), 2)), sensor.window, which=planes)
            mean_photons = np.square(spots).sum(axis=(1, 2))[self.psf.index_of(sensor.n)]
            table[spot_fits.WEIGHT_FLOOR] = sensor.excess_noise * mean_photons
