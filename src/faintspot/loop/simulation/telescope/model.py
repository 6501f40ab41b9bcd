"""Telescope model: wavefront, true values and pixels of one frame at a time."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from faintspot.loop.control.reconstructor import Reconstructor, check_controllable, make_reconstructor
from faintspot.loop.simulation.configuration.configuration import LoopConfiguration
from faintspot.loop.simulation.configuration.sections import (
    CLOSED,
    Atmosphere,
    Camera,
    ControlParameters,
    RunLength,
)
from faintspot.loop.simulation.telescope.atmosphere import MovingLayers, make_atmosphere
from faintspot.loop.simulation.telescope.calibration import (
    interaction_matrix,
    make_detector,
    true_interaction_matrix,
)
from faintspot.loop.simulation.telescope.mirror import (
    DeformableMirror,
    PupilAmplitude,
    make_mirror,
    make_pupil,
)
from faintspot.loop.simulation.telescope.wavefront_sensor import ShackHartmann, make_sensor

if TYPE_CHECKING:
    from faintspot.loop.simulation.telescope.laser import LaserSource

_OF_AIR = (
    "frame_rate_hz",
    "delay_frames",
    "mode",
    "largest_condition",
)  # of the control: of typical spots, too


@dataclass(frozen=True, eq=False)
class LoopOptics:
    """Parts that are the same in all runs of a configuration."""

    pupil: PupilAmplitude
    sensor: ShackHartmann
    mirror: DeformableMirror
    interaction: NDArray[np.float64]
    """(2 n, commands) px for 1 nm."""
    reconstructor: Reconstructor


@dataclass(frozen=True, eq=False)
class Truth:
    """True values of a frame, which only a simulation knows."""

    strehl: float
    rms_nm: float
    """Rms of the wavefront after the mirror, over the pupil, without piston."""
    r0_m: float


class TelescopeModel:
    """Model of star, atmosphere, telescope, mirror, sensor and camera.

    Air and noise depend on seed, realisation and frame alone.

    Parameters
    ----------
    configuration : LoopConfiguration
    seed, realisation : int

    Attributes
    ----------
    optics : LoopOptics
    atmosphere : MovingLayers
        May be changed between two frames, as may
    photons : float
        photo-electrons of a fully lit sub-aperture in a frame.
    detector : Detector
    """

    def __init__(self, configuration: LoopConfiguration, seed: int, realisation: int = 0) -> None:
        self.optics = prepare(configuration)
        self.atmosphere = atmosphere_of(without_flux(configuration), seed, realisation)
        self.photons = configuration.photons
        self.detector = make_detector(configuration)
        self._laser = laser_source(configuration)
        self._sees_mirror = configuration.control.mode == CLOSED
        self._science = configuration.science
        self._seed, self._realisation = seed, realisation

    def wavefronts(
        self, time_s: float, commands: NDArray[np.floating]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the wavefront after the mirror, and the one that the sensor sees, nm, (points, points)."""
        atmosphere = self.atmosphere.wavefront_nm(time_s)
        after = atmosphere + self.optics.mirror.wavefront_nm(commands)
        return after, after if self._sees_mirror else atmosphere

    def truth(self, time_s: float, wavefront_nm: NDArray[np.float32]) -> Truth:
        """Return the true values of a residual wavefront."""
        pupil = self.optics.pupil
        field = pupil.field(wavefront_nm, self._science.wavelength_m)
        strehl = self._science.static_strehl * pupil.strehl(field)
        return Truth(strehl, pupil.rms(wavefront_nm), self.atmosphere.r0_m(time_s))

    def frame(self, number: int, wavefront_nm: NDArray[np.float32]) -> NDArray[np.generic]:
        """Return the camera frame [ADU] of a wavefront; the number seeds its noise."""
        sensor, seeds = self.optics.sensor, (self._seed, self._realisation, number)
        if self._laser is not None:
            sensor = self._laser.sensor(number)
            wavefront_nm = self._laser.jittered(wavefront_nm, seeds)
        flux = sensor.frame(sensor.spots(wavefront_nm)) * self.photons
        rng = np.random.default_rng([*seeds, 2])
        return self.detector.expose(flux, rng)


def prepare(configuration: LoopConfiguration) -> LoopOptics:
    """Return telescope, sensor, mirror and their calibration (cached).

    Raises
    ------
    InputError
        When no sub-aperture is lit, or there are more commands than slopes can control.
    MissingExtraError
        When HCIPy is not installed.
    """
    return _prepared(of_optics(configuration))


def of_optics(configuration: LoopConfiguration) -> LoopConfiguration:
    """Return the configuration without values that do not affect the optics, so that these are kept."""
    control, camera = configuration.control, Camera(photons_per_subaperture=1.0)
    kept = ControlParameters(largest_condition=control.largest_condition)
    if configuration.laser is not None:  # which changes with time
        kept = replace(kept, frame_rate_hz=control.frame_rate_hz)
    return replace(
        configuration,
        name="-",
        atmosphere=Atmosphere(),
        camera=camera,
        control=kept,
        run=RunLength(),
        natural_star=None,
    )


def without_flux(configuration: LoopConfiguration) -> LoopConfiguration:
    """Return the configuration without values that do not affect the wavefronts, so that these are kept."""
    control = ControlParameters(**{name: getattr(configuration.control, name) for name in _OF_AIR})
    camera = Camera(photons_per_subaperture=1.0)
    return replace(configuration, name="-", camera=camera, control=control, run=RunLength())


def laser_source(configuration: LoopConfiguration) -> LaserSource | None:
    """Return the laser guide star of a configuration, None without (cached)."""
    return None if configuration.laser is None else _laser_source(of_optics(configuration))


@lru_cache(maxsize=2)
def _laser_source(configuration: LoopConfiguration) -> LaserSource:
    from faintspot.loop.simulation.telescope.laser import LaserSource

    return LaserSource(configuration, _prepared(configuration).sensor)


@lru_cache(maxsize=2)
def atmosphere_of(configuration: LoopConfiguration, seed: int, realisation: int) -> MovingLayers:
    """Return the atmosphere of a configuration `without_flux` (cached)."""
    return make_atmosphere(configuration, seed, realisation)


@lru_cache(maxsize=2)
def _prepared(configuration: LoopConfiguration) -> LoopOptics:
    pupil = make_pupil(configuration)
    sensor, mirror = make_sensor(configuration, pupil), make_mirror(configuration, pupil)
    check_controllable(mirror.commands, 2 * len(sensor.layout))
    # Calibrated with a point source, whose images in windows for a laser are too coarse: true gradients.
    measure = interaction_matrix if configuration.laser is None else true_interaction_matrix
    interaction = measure(sensor, mirror)
    reconstructor = make_reconstructor(interaction, configuration.control.largest_condition)
    return LoopOptics(pupil, sensor, mirror, interaction, reconstructor)
