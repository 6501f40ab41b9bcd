"""Sensor for which an estimator is prepared: geometry, camera and knowledge of the spots."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from faintspot.camera.calibration import Calibration
from faintspot.sensor.layout import Layout
from faintspot.spots.psf import PSF
from faintspot.spots.score import Score

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Sensor:
    """Layout, camera and spots of a sensor, as seen by an estimator.

    Parameters
    ----------
    layout : Layout
    calibration : Calibration
    psf, score : PSF, Score, or None
    zero : (n, 2) array
        Reference positions, px from the window centres.
    search_range_px : (n,) array
        Largest distance of a position from the reference; infinite if there is no limit.
    flux_e : (n,) array
        Expected flux [electrons]; NaN where unknown.
    given_fwhm_px : (n, 2) array
        Full width at half maximum of the spots along x and y; NaN where not given.
    width : int
        Number of SIMD lanes.
    """

    layout: Layout
    calibration: Calibration
    psf: PSF | None
    score: Score | None
    zero: Floats
    search_range_px: Floats
    flux_e: Floats
    given_fwhm_px: Floats
    width: int

    @property
    def n(self) -> int:
        """Number of sub-apertures."""
        return len(self.layout)

    @property
    def window(self) -> tuple[int, int]:
        """ny, nx of a sub-aperture, px."""
        return self.layout.window

    @property
    def pixels(self) -> int:
        """Number of pixels of a sub-aperture."""
        return self.layout.pixels

    @property
    def excess_noise(self) -> float:
        """Factor on the variance of the photon noise."""
        return self.calibration.excess_noise

    @property
    def variance(self) -> float:
        """Variance of a dark pixel [photo-electrons^2]; 0 if the read noise is unknown."""
        noise = self.calibration.read_noise_photoelectrons
        background = self.calibration.excess_noise * self.calibration.background_e
        return 0.0 if noise is None else noise**2 + background

    @cached_property
    def spot_fwhm_px(self) -> Floats:
        """Full width at half maximum of each spot along x and y, (n, 2); NaN where unknown."""
        given = self.given_fwhm_px
        if self.psf is None:
            return given
        learnt = self.psf.fwhm_px[self.psf.index_of(self.n)]
        return np.where(np.isnan(given), learnt, given)
