"""Sensor for which an estimator is prepared, and the scene from which its options are chosen."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from faintspot.base.arrays import Floats
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.spots.fixed_weights import FixedWeights
from faintspot.slopes.spots.psf import PSF


@dataclass(frozen=True, eq=False)
class Sensor:
    """Layout, camera and spots of a sensor, as seen by an estimator.

    Parameters
    ----------
    layout : Layout
    calibration : Calibration
    psf, weights : PSF, FixedWeights, or None
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
    weights: FixedWeights | None
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
    def has_noise_map(self) -> bool:
        """Whether the read noise differs from pixel to pixel."""
        return isinstance(self.calibration.read_noise_e, np.ndarray)

    @cached_property
    def pixel_noise_e(self) -> Floats:
        """Read noise [photo-electrons] of each pixel, (n, ny, nx), or of all, (n, 1, 1); 0 if it is unknown.

        Bad pixels, which are filled in, count with the mean variance of their window.
        """
        usual = self.calibration.read_noise_photoelectrons or 0.0
        noise = self.calibration.read_noise_map(self.layout.frame_shape)
        if noise is None:
            return np.full((self.n, 1, 1), usual)
        squares = np.square(self.layout.images(noise))
        known = ~np.isnan(squares)
        count = known.sum(axis=(1, 2))
        total = np.where(known, squares, 0.0).sum(axis=(1, 2))
        mean = np.where(count > 0, total / np.maximum(count, 1), usual**2)
        return np.sqrt(np.where(known, squares, mean[:, None, None]))

    @property
    def read_noise_e(self) -> Floats:
        """Read noise of each sub-aperture [photo-electrons], (n,): the root mean square of its pixels."""
        return np.asarray(np.sqrt(np.square(self.pixel_noise_e).mean(axis=(1, 2))))

    @property
    def pixel_variance(self) -> Floats:
        """Variance [photo-electrons^2] of each dark pixel, shaped as `pixel_noise_e`; 0 if it is unknown."""
        if self.calibration.read_noise_e is None:
            return np.zeros((self.n, 1, 1))
        background = self.calibration.excess_noise * self.calibration.background_e
        return np.asarray(np.square(self.pixel_noise_e) + background)

    @cached_property
    def spot_fwhm_px(self) -> Floats:
        """Full width at half maximum of each spot along x and y, (n, 2); NaN where unknown."""
        given = self.given_fwhm_px
        if self.psf is None:
            return given
        learnt = self.psf.fwhm_px[self.psf.index_of(self.n)]
        return np.where(np.isnan(given), learnt, given)


PIXEL_BLUR_PX2 = 0.46
"""Increase of a Gaussian spot's squared FWHM due to integration over a pixel [px^2]."""


@dataclass(frozen=True)
class Scene:
    """Flux, camera and spots of a star.

    Parameters
    ----------
    flux_e : float
        Flux of a spot in a frame [photo-electrons].
    read_noise_e : float
        Read noise [photo-electrons].
    window : (int, int)
        Size of a sub-aperture window, ny and nx [px].
    spot_fwhm_px : float
        Full width at half maximum of the optical spot, without the blur of the pixels [px].
    position_range_px : float
        Largest distance of the spots from the reference position on each axis [px].
    elongation : float
        Ratio of the widths along the long and the short axis.
    excess_noise : float
        Factor on the variance of the photon noise: 2 for an EMCCD at high gain.
    background_e : float
        Background per pixel [photo-electrons], whose mean is subtracted and whose noise remains.
    d_over_r0 : float
        Side of a sub-aperture in Fried parameters at the sensor's wavelength, if the spots are speckled;
        otherwise 0.
    diffraction_px : float, optional
        lambda / d on the detector [px]. Default: that of a spot of this width.
    profile : str
        Spot profile, "diffraction" or "gaussian".
    learnt : bool
        Whether the PSF was learnt from frames.

    Examples
    --------
    >>> from faintspot.slopes.estimators import Scene
    >>> scene = Scene(flux_e=100.0, read_noise_e=1.0, window=(8, 8), spot_fwhm_px=1.8, position_range_px=1.0)
    >>> round(scene.seen_fwhm_px, 2)
    1.92
    """

    flux_e: float
    read_noise_e: float
    window: tuple[int, int]
    spot_fwhm_px: float
    position_range_px: float
    elongation: float = 1.0
    excess_noise: float = 1.0
    background_e: float = 0.0
    d_over_r0: float = 0.0
    diffraction_px: float | None = None
    profile: str = "diffraction"
    learnt: bool = False

    @property
    def pixels(self) -> int:
        """Number of pixels of a window."""
        return self.window[0] * self.window[1]

    @property
    def dark_noise_e(self) -> float:
        """Noise of a dark pixel, photo-electrons."""
        return math.sqrt(self.read_noise_e**2 + self.excess_noise * self.background_e)

    @property
    def seen_fwhm_px(self) -> float:
        """Width of the spots including the blur of the pixels."""
        return math.sqrt(self.spot_fwhm_px**2 + PIXEL_BLUR_PX2)

    @property
    def lambda_over_d_px(self) -> float:
        """Lambda / d, px."""
        return self.spot_fwhm_px / 0.886 if self.diffraction_px is None else self.diffraction_px

    @property
    def rule_arguments(self) -> dict[str, Any]:
        """Arguments of the automatic rules, see `faintspot.slopes.estimators.automatic`."""
        return {
            "flux_e": self.flux_e,
            "read_noise_e": self.read_noise_e,
            "pixels": self.pixels,
            "spot_fwhm_px": self.spot_fwhm_px,
            "elongation": self.elongation,
            "excess_noise": self.excess_noise,
            "background_e": self.background_e,
            "position_range_px": self.position_range_px,
            "profile": self.profile,
        }
