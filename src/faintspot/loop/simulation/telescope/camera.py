"""Camera of the wavefront sensor, with or without noise, and its calibration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from faintspot.loop.simulation.configuration.configuration import LoopConfiguration
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.camera.detector import Detector


class Exposing(Protocol):
    """A camera."""

    def expose(self, mean_e: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.generic]:
        """Return a frame with this flux in each pixel."""


@dataclass(frozen=True, eq=False)
class NoiselessDetector:
    """A camera without photon noise, read noise and quantisation."""

    detector: Detector

    def expose(self, mean_e: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float32]:
        """Return the mean frame, ADU."""
        camera = self.detector
        flux = mean_e + camera.background_e + camera.dark_e
        adu = camera.offset_adu + flux * camera.em_gain / camera.gain_e_per_adu
        return adu.astype(np.float32)


def make_detector(configuration: LoopConfiguration) -> Detector:
    """Return the sensor's camera."""
    camera = configuration.camera
    return Detector(
        camera.read_noise_e,
        dark_e=camera.dark_e,
        background_e=camera.background_e,
        em_gain=camera.em_gain,
        gain_e_per_adu=camera.gain_e_per_adu,
        offset_adu=camera.offset_adu,
        bits=camera.bits,
    )


def camera_calibration(configuration: LoopConfiguration) -> Calibration:
    """Return the calibration from the camera's frames to electrons of the star."""
    camera = configuration.camera
    background = camera.background_e + camera.dark_e
    return Calibration(
        dark=camera.offset_adu + background * camera.em_gain / camera.gain_e_per_adu,
        gain_e_per_adu=camera.gain_e_per_adu,
        em_gain=camera.em_gain,
        read_noise_e=camera.read_noise_e,
        background_e=background,
    )
