"""Maximum likelihood for Poisson and Gaussian noise."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from faintspot.base.config.options import Value, option
from faintspot.slopes.estimators.base import Estimator, Need, Style
from faintspot.slopes.estimators.registry import register
from faintspot.slopes.estimators.scene import Scene
from faintspot.slopes.estimators.sensor import Sensor
from faintspot.slopes.estimators.spot_tables import SpotModel, model_of_psf
from faintspot.slopes.estimators.spots import SpotPlan, Stepping
from faintspot.slopes.kernels.spot_fits import fits as spot_fits

_BLURS = (0.4, 0.0, 0.8, 1.2)  # of the PSF of a speckled spot, in units of lambda / d
_MODEL_ERRORS = (0.3, 0.0, 1.0)  # for speckled spots
_LEARNT_WEIGHT_FLOOR = 1e-3


@dataclass(frozen=True, eq=False, kw_only=True)
class Likelihood(Stepping):
    """Fit of the PSF to the image, whose weights follow from the noise."""

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
    model_error: Value = option(
        0.0,
        "Deviation of the spots from the PSF, as a fraction of each pixel's flux; it limits the weight of "
        "bright pixels. 0.1 to 0.5 for speckled spots. Values above sqrt(300 e- / flux) are reduced to it.",
        low=0.0,
        high=10.0,
    )
    weight_floor: Value = option(
        2e-4,
        "Variance, as a fraction of the flux, added to the variance of every pixel, so that small errors "
        "of the PSF in dark wings do not get large weights.",
        low=0.0,
        high=1.0,
    )

    needs = frozenset({Need.PSF, Need.READ_NOISE})

    def for_scene(self, scene: Scene) -> Self:
        """Reduce the weight of the wings of a learnt PSF."""
        return self.replaced({"weight_floor": _LEARNT_WEIGHT_FLOOR}) if scene.learnt else self

    def for_bright_flux(self) -> Self:
        """Keep the number of steps: more would follow the weights of high flux."""
        return self

    def tuned(self, scene: Scene) -> Mapping[str, Sequence[object]]:
        """Return blurs of the PSF and model errors to try for speckled spots."""
        if not scene.d_over_r0:
            return {}
        blurs = [factor * scene.lambda_over_d_px for factor in _BLURS]
        return {"blur_px": blurs, "model_error": list(_MODEL_ERRORS)}


@register
@dataclass(frozen=True, eq=False, kw_only=True)
class MaximumLikelihood(Likelihood):
    """Position and flux of maximum likelihood, by Fisher scoring."""

    name = "ml"
    label = "maximum likelihood"
    method = "maximum likelihood for Poisson and Gaussian noise"
    cost = 0.27
    style = Style("#0072B2", "-", "P")

    def prepared(self, sensor: Sensor) -> LikelihoodPlan:
        """See `Estimator`."""
        return LikelihoodPlan(self, sensor)


class LikelihoodPlan(SpotPlan):
    """Tables of a weighted fit; pixels with low read noise are rounded to whole electrons."""

    kernel = staticmethod(spot_fits.fitted_of_groups)

    def __init__(self, estimator: Estimator, sensor: Sensor) -> None:
        super().__init__(estimator, sensor)
        if self.rounds_electrons:
            noise = sensor.pixel_noise_e
            rounded = noise < spot_fits.WHOLE_ELECTRONS_BELOW
            self.pixel_variance = np.where(rounded, _rounding_variance(noise), self.pixel_variance)

    @cached_property
    def model(self) -> SpotModel:
        """Profiles of the spots."""
        sensor = self.sensor
        return model_of_psf(self.psf, sensor.n, sensor.window, sensor.width, self.fits_background)

    @property
    def rounds_electrons(self) -> bool:
        """See `SpotPlan`."""
        camera = self.sensor.calibration
        known = camera.read_noise_e is not None
        low = known and bool(np.any(self.sensor.pixel_noise_e < spot_fits.WHOLE_ELECTRONS_BELOW))
        whole = camera.em_gain == 1 and camera.background_e == 0 and not self.fits_background
        return low and whole

    def fill(self, table: NDArray[np.float32]) -> None:
        """See `EstimatorPlan`."""
        super().fill(table)
        table[spot_fits.WEIGHT_FLOOR] = self.each("weight_floor")
        table[spot_fits.WEIGHT_EXCESS] = self.sensor.excess_noise
        table[spot_fits.MODEL_ERROR] = self.each("model_error")


@np.vectorize
def _rounding_variance(noise_e: float) -> float:
    """Return the variance after rounding: one electron more or less where the noise exceeds one half."""
    return math.erfc(0.5 / (noise_e * math.sqrt(2.0))) if noise_e > 0 else 0.0
