"""What a telescope knows of the sodium layer: a profile learnt before a run, and followed in it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from faintspot.ao_loop.configuration import ARCSEC, LoopConfiguration
from faintspot.ao_loop.laser import laser_guide_star
from faintspot.ao_loop.methods import Method
from faintspot.sensor.layout import Layout
from faintspot.spots.fixed_weights import FixedWeights
from faintspot.spots.laser import LaserGuideStar
from faintspot.spots.psf import PSF
from faintspot.spots.sodium import SodiumProfile
from faintspot.training.sodium import MeanImages, SodiumFit, fit_sodium_profile, fit_spot

Floats = NDArray[np.float64]

_ALTITUDES = 41  # of the profile that is fitted
_FIRST_FWHM = 0.35  # of the range of altitudes: single layer from which the fit begins
_NARROWEST_PX = 1.2  # spot from which the fit begins
_BEYOND_PX = 3.0  # of the window, to which PSFs reach
_OF_LEARNING = 8  # random numbers


@dataclass(frozen=True, eq=False)
class KnownSodium:
    """Profile, spot and fluxes that mean images have shown."""

    star: LaserGuideStar
    """Whose spot includes turbulence and the motion of the spots."""
    fit: SodiumFit
    dark_variance_e2: float

    def psf(self, pixels: int) -> PSF:
        """Return the PSF of every sub-aperture, for windows of some pixels."""
        return self.star.psf(self.fit.profile, radius_px=0.5 * pixels + _BEYOND_PX)

    def updated(self, mean: MeanImages) -> KnownSodium:
        """Return it with the profile of newer mean images."""
        fit = fit_sodium_profile(mean, self.star, self.fit.profile, dark_variance_e2=self.dark_variance_e2)
        return replace(self, fit=fit)

    def method(self, configuration: LoopConfiguration, method: Method) -> Method:
        """Return a method that knows these spots."""
        pixels = method.window_pixels or configuration.sensor.pixels
        psf, scene = self.psf(pixels), configuration.scene
        if not method.matched_weights:
            return replace(method, psf=psf)
        weights = FixedWeights.matched(
            psf,
            (pixels, pixels),
            flux_e=np.maximum(self.fit.flux_e, 1.0),
            read_noise_e=scene.read_noise_e,
            excess_noise=scene.excess_noise,
            background_e=scene.background_e,
        )
        return replace(method, psf=psf, score=weights)


def learn_sodium(
    configuration: LoopConfiguration, layout: Layout, spots: NDArray[np.float32], seed: int
) -> KnownSodium:
    """Return what the mean of `laser.learn_frames` frames shows, beginning with a single layer.

    Parameters
    ----------
    configuration : LoopConfiguration
        With a laser.
    layout : Layout
    spots : (wavefronts, n, pixels, pixels) array
        Images of unit flux before the run.
    seed : int
        Of the noise of the mean.
    """
    laser, scene = configuration.laser, configuration.scene
    assert laser is not None
    dark = scene.dark_noise_e**2
    mean_e = configuration.photons * spots.mean(axis=0, dtype=np.float64)
    rng = np.random.default_rng([seed, _OF_LEARNING])
    noise = np.sqrt((scene.excess_noise * mean_e + dark) / laser.learn_frames)
    images = mean_e + noise * rng.standard_normal(mean_e.shape)
    mean = MeanImages(images, np.zeros((len(layout), 2)), frames=laser.learn_frames)
    low, high = laser.altitude_m[0], laser.altitude_m[-1]
    narrow = laser_guide_star(
        configuration, layout.cells, _NARROWEST_PX * configuration.pixel_scale_rad / ARCSEC
    )
    layer = SodiumProfile.gaussian(laser.focus_altitude_m, _FIRST_FWHM * (high - low))
    start = narrow.focused(layer).at(np.linspace(low, high, _ALTITUDES))
    return KnownSodium(*fit_spot(mean, narrow, start, dark_variance_e2=dark), dark)


class FollowedSodium:
    """Sodium profile of a method that follows it, from the running mean of its own frames.

    Parameters
    ----------
    configuration : LoopConfiguration
        With a laser.
    layout : Layout
    known : KnownSodium
        Known before the run.
    """

    def __init__(self, configuration: LoopConfiguration, layout: Layout, known: KnownSodium) -> None:
        assert configuration.laser is not None
        self._laser, self._layout = configuration.laser, layout
        camera = configuration.camera
        background = camera.background_e + camera.dark_e
        self._scale = camera.gain_e_per_adu / camera.em_gain
        self._dark_adu = camera.offset_adu + background / self._scale
        self._mean: MeanImages | None = None
        self._frames = 0
        self.known = known

    def take(self, frame_adu: NDArray[np.generic], slopes_px: Floats) -> bool:
        """Take a frame and its slopes (2 n,) from the window centres; return whether the profile is new."""
        images = self._layout.images((frame_adu.astype(np.float64) - self._dark_adu) * self._scale)
        places = slopes_px.reshape(2, -1).T
        if self._mean is None:
            self._mean = MeanImages(images, places, self._laser.follow_time_constant_frames)
        else:
            self._mean = self._mean.updated(images, places)
        self._frames += 1
        if self._frames % self._laser.follow_every_frames:
            return False
        self.known = self.known.updated(self._mean)
        return True
