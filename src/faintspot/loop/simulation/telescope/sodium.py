"""Knowledge of the sodium layer in a simulated loop: a profile learnt before a run, and followed in it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from faintspot.base.checks import not_none
from faintspot.loop.simulation.configuration.configuration import LoopConfiguration
from faintspot.loop.simulation.methods import Method
from faintspot.loop.simulation.telescope.laser import laser_guide_star
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.spots.fixed_weights import FixedWeights
from faintspot.slopes.spots.sodium import SodiumProfile
from faintspot.slopes.training.known_sodium import KnownSodium
from faintspot.slopes.training.sodium import MeanImages

Floats = NDArray[np.float64]

_ALTITUDES = 41  # of the profile that is fitted
_FIRST_FWHM = 0.35  # of the range of altitudes: single layer from which the fit begins
_OF_LEARNING = 8  # random numbers


def with_spots(sodium: KnownSodium, configuration: LoopConfiguration, method: Method) -> Method:
    """Return a method that knows the spots."""
    pixels = method.window_pixels or configuration.sensor.pixels
    psf, scene = sodium.psf((pixels, pixels)), configuration.scene
    if not method.matched_weights:
        return replace(method, psf=psf)
    weights = FixedWeights.matched(
        psf,
        (pixels, pixels),
        flux_e=np.maximum(sodium.fit.flux_e, 1.0),
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
    laser, scene = not_none(configuration.laser), configuration.scene
    dark = scene.dark_noise_e**2
    mean_e = configuration.photons * spots.mean(axis=0, dtype=np.float64)
    rng = np.random.default_rng([seed, _OF_LEARNING])
    noise = np.sqrt((scene.excess_noise * mean_e + dark) / laser.learn_frames)
    images = mean_e + noise * rng.standard_normal(mean_e.shape)
    mean = MeanImages(images, np.zeros((len(layout), 2)), frames=laser.learn_frames)
    low, high = laser.altitude_m[0], laser.altitude_m[-1]
    star = laser_guide_star(configuration, layout.cells, laser.spot_fwhm_arcsec)
    layer = SodiumProfile.gaussian(laser.focus_altitude_m, _FIRST_FWHM * (high - low))
    start = star.focused(layer).at(np.linspace(low, high, _ALTITUDES))
    return KnownSodium.learnt(mean, star, start, dark)


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

    def __init__(self, configuration: LoopConfiguration, layout: Layout, sodium: KnownSodium) -> None:
        self._laser, self._layout = not_none(configuration.laser), layout
        camera = configuration.camera
        background = camera.background_e + camera.dark_e
        self._scale = camera.gain_e_per_adu / camera.em_gain
        self._dark_adu = camera.offset_adu + background / self._scale
        self._mean: MeanImages | None = None
        self._frames = 0
        self.sodium = sodium

    def take(self, frame_adu: NDArray[np.generic], slopes_px: Floats) -> bool:
        """Take a frame and its slopes (2 n,) from the window centres; return whether the profile is new."""
        images = self._layout.images((frame_adu.astype(np.float64) - self._dark_adu) * self._scale)
        positions = slopes_px.reshape(2, -1).T
        if self._mean is None:
            self._mean = MeanImages(images, positions, self._laser.follow_time_constant_frames)
        else:
            self._mean = self._mean.updated(images, positions)
        self._frames += 1
        if self._frames % self._laser.follow_every_frames:
            return False
        self.sodium = self.sodium.updated(self._mean)
        return True
