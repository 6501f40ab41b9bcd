"""Knowledge of the sodium layer: a profile that mean images have shown, and the spots that follow from it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.estimators.scene import PIXEL_BLUR_PX2
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.spots.laser import LaserGuideStar, gaussian_spot
from faintspot.slopes.spots.laser_spots import psf_in_window
from faintspot.slopes.spots.psf import PSF
from faintspot.slopes.spots.sodium import SodiumProfile
from faintspot.slopes.training.sodium import MeanImages, SodiumFit, fit_sodium_profile, fit_spot

Floats = NDArray[np.float64]

_NARROWEST_PX = 1.2  # spot from which the fit begins
_FEWEST_ALTITUDES, _ALTITUDES = 20, 41
IGNORED_E2 = 1e12
"""Variance of pixels that do not count [electrons^2]."""


@dataclass(frozen=True, eq=False)
class KnownSodium:
    """Profile, spot and fluxes that mean images have shown."""

    star: LaserGuideStar
    """Laser guide star; its spot includes turbulence and the motion of the spots."""
    fit: SodiumFit
    dark_variance_e2: ArrayLike

    @classmethod
    def learnt(
        cls, mean: MeanImages, star: LaserGuideStar, profile: SodiumProfile, dark_variance_e2: ArrayLike
    ) -> KnownSodium:
        """Return profile and width of the spot, both fitted to mean images.

        Parameters
        ----------
        mean : MeanImages
        star : LaserGuideStar
            The width of its spot does not count.
        profile : SodiumProfile
            First estimate, whose range of altitudes is kept.
        dark_variance_e2 : float or (n, ny, nx) array
            As for `fit_sodium_profile`.

        Raises
        ------
        InputError
            As for `fit_sodium_profile`.
        """
        altitudes = profile.altitudes_m
        if len(altitudes) < _FEWEST_ALTITUDES:
            altitudes = np.linspace(altitudes[0], altitudes[-1], _ALTITUDES)
        narrow = replace(star, spot=gaussian_spot(_NARROWEST_PX))
        star_and_fit = fit_spot(mean, narrow, profile.at(altitudes), dark_variance_e2=dark_variance_e2)
        return cls(*star_and_fit, dark_variance_e2)

    def updated(self, mean: MeanImages) -> KnownSodium:
        """Return it with the profile of newer mean images."""
        fit = fit_sodium_profile(mean, self.star, self.fit.profile, dark_variance_e2=self.dark_variance_e2)
        return replace(self, fit=fit)

    def psf(self, window: tuple[int, int]) -> PSF:
        """Return the PSF of every sub-aperture, for windows (ny, nx)."""
        return psf_in_window(self.star, self.fit.profile, window)

    @property
    def spot_fwhm_arcsec(self) -> float:
        """Full width at half maximum of the spot at a single altitude, without the pixel."""
        width_px = float(self.star.spot.fwhm_px.mean())  # exact for Gaussian spots
        return math.sqrt(max(width_px**2 - PIXEL_BLUR_PX2, 0.0)) * self.star.pixel_arcsec


def calibrated_images(
    frames: ArrayLike, layout: Layout, calibration: Calibration
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return images of every sub-aperture [electrons], 0 in bad pixels, and which pixels are bad.

    Parameters
    ----------
    frames : (h, w) or (n, h, w) array
        In ADU.
    layout : Layout
    calibration : Calibration

    Returns
    -------
    (..., n_subapertures, ny, nx) array, (n_subapertures, ny, nx) array
    """
    dark, electrons_per_adu = layout.images(calibration.maps(layout.frame_shape))
    images = (layout.images(np.asarray(frames)) - dark) * electrons_per_adu
    bad = ~np.isfinite(dark * electrons_per_adu)
    return np.where(np.isfinite(images), images, np.float32(0.0)).astype(np.float32), bad


def dark_variance_e2(layout: Layout, calibration: Calibration) -> Floats:
    """Return the variance of a dark pixel in one frame [electrons^2], (n_subapertures, ny, nx).

    That of bad pixels is so large that they do not count; without a known read noise it is 1.
    """
    noise = calibration.read_noise_map(layout.frame_shape)
    if noise is None:
        noise_e = calibration.read_noise_photoelectrons
        noise = np.full(layout.frame_shape, 1.0 if noise_e is None else noise_e)
    bad = ~np.isfinite(calibration.maps(layout.frame_shape)).all(axis=0)
    variance: Floats = layout.images(np.where(bad, IGNORED_E2, np.nan_to_num(noise) ** 2))
    return variance
