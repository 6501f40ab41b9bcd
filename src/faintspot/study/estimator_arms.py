"""The arms of a study that know the spot: the estimators, and what they have to know."""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot import estimators
from faintspot.sensor.calibration import Calibration
from faintspot.sensor.psf import PSF
from faintspot.sensor.score import TrainedScore
from faintspot.settings import Settings
from faintspot.simulate import Detector
from faintspot.slopes import Slopes
from faintspot.study.specification import Candidate, Robustness
from faintspot.study.sweep import Cell
from faintspot.training import train_estimator

_TRAINING = 1  # word that is added to a cell's seed

Images = NDArray[np.float32]


def detector_of(cell: Cell) -> Detector:
    """Return the camera of a cell."""
    return Detector(
        read_noise_e=cell.read_noise_e * cell.em_gain, background_e=cell.background_e, em_gain=cell.em_gain
    )


class EstimatorArms:
    """Measures images of a cell with estimators that know its spot and its camera.

    Parameters
    ----------
    cell : Cell
    seed : int
        Of the study. "trained" is trained on spots of a seed of its own.
    search_range_px : float
        Positions are sought within plus and minus this on each axis: of "map" also the (uniform) prior.
    light_e : float
        Mean electrons of an image, as measured.
    """

    def __init__(self, cell: Cell, seed: int, search_range_px: float, light_e: float) -> None:
        self._cell, self._seed = cell, seed
        self._search_range_px = min(search_range_px, cell.pixels / 2)
        self._light_e = max(light_e, 1e-3)  # a mean of noise may be negative
        self._calibration = Calibration(
            read_noise_e=cell.read_noise_e * cell.em_gain,
            em_gain=cell.em_gain,
            background_e=cell.background_e,
        )

    def measure(self, arm: str, candidate: Candidate, images: Images) -> Slopes:
        """Return the slopes of images (n, side, side) in photo-electrons.

        Parameters
        ----------
        arm : str
            One of `faintspot.study.specification.ESTIMATOR_ARMS`.
        candidate : float or Robustness
            "weighted": width of the weight as a fraction of the spot's; NaN for "trained"; `Robustness` for
            the others.
        images : (n, side, side) array
        """
        known: dict[str, Any] = {}
        spot: dict[str, Any] = {}
        if isinstance(candidate, Robustness):
            spot = {"psf": _psf(self._cell, self._search_range_px, candidate.blur_px)}
            known = {"model_error": candidate.model_error}
        elif arm == "weighted":
            along, across = self._spot_fwhm_px
            weight = candidate * math.sqrt(along * across)
            known = {"spot_fwhm_px": along, "spot_fwhm_y_px": across, "weight_fwhm_px": weight}
        else:
            spot = {"score": self._score}
        settings = Settings(
            estimator=arm, search_range_px=self._search_range_px, flux_e=self._light_e, **known
        )
        output = images * np.float32(self._cell.em_gain)  # as the camera gives it
        return estimators.measure(output, settings, calibration=self._calibration, **spot)

    @functools.cached_property
    def _spot_fwhm_px(self) -> tuple[float, float]:
        """Width along x and y, without turbulence."""
        along, across = _psf(self._cell, self._search_range_px, 0.0).fwhm_px[0].tolist()
        return along, across

    @functools.cached_property
    def _score(self) -> TrainedScore:
        cell = self._cell
        entropy = [*cell.seed(self._seed).entropy, _TRAINING]  # type: ignore[misc]
        return train_estimator(
            flux_e=self._light_e,
            detector=detector_of(cell),
            shape=(cell.pixels, cell.pixels),
            profile=cell.profile,
            size=cell.size,
            elongation=cell.elongation,
            d_over_r0=cell.d_over_r0,
            position_range_px=cell.position_range_px,
            search_range_px=self._search_range_px,
            rng=np.random.default_rng(np.random.SeedSequence(entropy)),
        )


@functools.lru_cache(maxsize=16)
def _psf_of(profile: str, size: float, elongation: float, radius_px: float, blur_px: float) -> PSF:
    psf = PSF.analytic(profile, size=size, elongation=elongation, radius_px=radius_px)
    return psf.blurred(blur_px) if blur_px else psf


def _psf(cell: Cell, search_range_px: float, blur_px: float) -> PSF:
    """Return the PSF without turbulence, blurred, as far out as a window sees it."""
    radius = math.ceil(cell.pixels / 2 + search_range_px) + 2
    return _psf_of(cell.profile, cell.size, cell.elongation, radius, blur_px)
