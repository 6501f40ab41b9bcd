"""Low orders that a laser guide star cannot measure, from a natural star: tip, tilt and slow focus."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from faintspot.loop.control.removed_modes import TIP_TILT, RemovedModes
from faintspot.loop.simulation.configuration.configuration import LoopConfiguration
from faintspot.loop.simulation.telescope.laser import subaperture_centres_m
from faintspot.loop.simulation.telescope.wavefront_sensor import ShackHartmann
from faintspot.loop.turbulence.slope_covariance import ARCSEC
from faintspot.slopes.spots.shapes import FWHM_TO_STD

Floats = NDArray[np.float64]

_OF_NOISE = 6  # of a frame's random numbers


class LowOrders:
    """Slopes of a laser guide star with tip and tilt, and slowly focus, from a natural star.

    The natural star's sensor has four sub-apertures, the quadrants of the pupil. Tip and tilt are the mean of
    its slopes, and replace those of the laser's slopes, each time that `tip_tilt_frames` have been averaged;
    between, they are 0. Its focus moves the reference of the laser's focus by a fraction every
    `focus_frames`.

    Parameters
    ----------
    configuration : LoopConfiguration
        With a laser; without a natural star, tip and tilt are only removed.
    sensor : ShackHartmann
    seed, realisation : int
    """

    def __init__(
        self, configuration: LoopConfiguration, sensor: ShackHartmann, seed: int, realisation: int
    ) -> None:
        self._star, self._sensor = configuration.natural_star, sensor
        self._seed = seed, realisation
        self._tip_tilt = RemovedModes(TIP_TILT)
        centres_m = subaperture_centres_m(configuration, sensor.layout.cells)
        sides = centres_m > 0
        self._quadrant = sides[:, 0] + 2 * sides[:, 1]
        self._focus = centres_m.T.ravel()
        self._of_quadrants = self._means(self._focus)
        self._tilts = np.zeros(2)
        self._curved, self._offset = 0.0, 0.0
        if self._star is not None:
            pixel = configuration.pixel_scale_rad / ARCSEC
            quadrant_e = 0.25 * self._star.photons
            self._noise_px = self._star.fwhm_arcsec * FWHM_TO_STD / pixel / math.sqrt(quadrant_e)

    def merged(
        self, frame: int, wavefront_nm: NDArray[np.floating], slopes_px: Floats, flags: NDArray[np.uint8]
    ) -> Floats:
        """Return slopes (2 n,) of the laser with the low orders of the natural star.

        Parameters
        ----------
        frame : int
            Number of the frame, which seeds the noise.
        wavefront_nm : (points, points) array
            Wavefront that both sensors see.
        slopes_px : (2 n,) array
            Slopes of the laser guide star in true px.
        flags : (n,) array
            As in `faintspot.Slopes`.
        """
        merged = self._tip_tilt.removed(slopes_px, flags)
        if self._star is None:
            return merged
        rng = np.random.default_rng([*self._seed, frame, _OF_NOISE])
        means = self._means(self._sensor.mean_slopes_px(wavefront_nm))
        means = means + rng.normal(0.0, self._noise_px, means.shape)
        self._tilts += means.mean(axis=1)
        centred = self._of_quadrants - self._of_quadrants.mean(axis=1, keepdims=True)
        self._curved += float((centred * means).sum() / np.square(centred).sum())
        if (frame + 1) % self._star.focus_frames == 0:
            self._offset += self._star.focus_gain * self._curved / self._star.focus_frames
            self._curved = 0.0
        merged = merged + self._offset * self._focus
        if (frame + 1) % self._star.tip_tilt_frames == 0:
            merged = merged + np.repeat(self._tilts / self._star.tip_tilt_frames, len(flags))
            self._tilts = np.zeros(2)
        return merged

    def _means(self, slopes_px: Floats) -> Floats:
        """Return mean slopes of the quadrants, (2, 4)."""
        counts = np.bincount(self._quadrant, minlength=4)
        sums = [np.bincount(self._quadrant, slopes, 4) for slopes in slopes_px.reshape(2, -1)]
        return np.asarray(np.stack(sums) / np.maximum(counts, 1))
