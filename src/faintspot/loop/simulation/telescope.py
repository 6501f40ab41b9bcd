"""Telescope model, one frame at a time, and its calibration through the pipeline."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.loop.control.reconstructor import Reconstructor, check_controllable, make_reconstructor
from faintspot.loop.simulation.atmosphere import MovingLayers, make_atmosphere
from faintspot.loop.simulation.configuration import LoopConfiguration
from faintspot.loop.simulation.methods import Method
from faintspot.loop.simulation.sections import CLOSED, Atmosphere, Camera, ControlParameters, RunLength
from faintspot.loop.simulation.wavefront_sensor import (
    DeformableMirror,
    PupilAmplitude,
    ShackHartmann,
    make_mirror,
    make_pupil,
    make_sensor,
)
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.camera.detector import Detector
from faintspot.slopes.estimators.built_in.gravity import BrightestPixels
from faintspot.slopes.pipeline.light import MeanFlux
from faintspot.slopes.pipeline.settings import Settings
from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline
from faintspot.slopes.spots.psf import PSF, spot_psf


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


_BRIGHT_E = 1e6
_POKE_NM = 20.0
_DITHER_PX = 0.25
_DITHER_WAVEFRONTS = 60
_DITHER_STEP_S = 0.1  # between wavefronts, so that they differ
_SMALLEST_GAIN = 0.05  # less is noise, and dividing by it would make the loop unstable


def make_pipeline(configuration: LoopConfiguration, sensor: ShackHartmann, method: Method) -> SlopePipeline:
    """Return the pipeline of a method, with the reference slopes of a flat wavefront."""
    return SlopePipeline(
        sensor.layout,
        method.settings,
        camera_calibration(configuration),
        reference_slopes(configuration, sensor, method),
        psf=_psf(configuration, method),
        weights=method.weights,
        threads=1,
    )


def reference_slopes(
    configuration: LoopConfiguration, sensor: ShackHartmann, method: Method
) -> NDArray[np.float32]:
    """Return the slopes that a method measures for a flat wavefront, all x, then all y, (2 n,) px.

    References are measured with bright frames without noise, and without what is for faint flux:
    at its strength of denoising they would be denoised to nothing.
    """
    bright = SlopePipeline(
        sensor.layout,
        method.settings.replace(estimator=method.settings.estimator.for_bright_flux(), flux_e=None),
        Calibration(dark=0.0, read_noise_e=1.0),
        psf=_psf(configuration, method),
        weights=method.weights,
        threads=1,
    )
    flat = sensor.spots(np.zeros((sensor.points, sensor.points), np.float32))
    return bright(sensor.frame(flat) * _BRIGHT_E).vector


def _psf(configuration: LoopConfiguration, method: Method) -> PSF:
    if method.psf is not None:
        return method.psf
    return spot_psf(configuration.spot_width_px / 2, configuration.sensor.spot_elongation)


def interaction_matrix(sensor: ShackHartmann, mirror: DeformableMirror) -> Floats:
    """Return the displacements of the spots for a command of 1 nm of each actuator, (2 n, commands) px.

    Measured by poking each actuator up and down, with bright frames without noise, centres of gravity of all
    the flux in the windows, and divided by the slopes that a known displacement gives. All methods use it,
    each with its own reference slopes and its own centroid gain at the run's flux. A matrix through a
    method's own estimator with such frames was no better: it changed the Strehl ratio by -0.035 to 0.000 for
    the 20 brightest pixels, -0.007 to 0.016 for weighted centres of gravity, and -0.037 to -0.014 for
    likelihood, which sees bright spots with other weights than faint ones (80 to 1000 photons, 700 frames).
    """
    pixels = sensor.layout.pixels
    settings = Settings(BrightestPixels(keep_brightest=pixels - 1))
    pipeline = SlopePipeline(sensor.layout, settings, threads=1)

    def slopes(wavefront: NDArray[np.floating[Any]], displacement_px: float = 0.0) -> Floats:
        frame = sensor.frame(sensor.spots(wavefront, displacement_px)) * _BRIGHT_E
        return pipeline(frame).vector.astype(np.float64)

    flat = np.zeros((sensor.points, sensor.points), np.float32)
    gain = (slopes(flat, _DITHER_PX) - slopes(flat, -_DITHER_PX)) / (2 * _DITHER_PX)
    columns = []
    for command in range(mirror.commands):
        poke = np.zeros(mirror.commands)
        poke[command] = _POKE_NM
        shape = mirror.wavefront_nm(poke)
        columns.append((slopes(shape) - slopes(-shape)) / (2 * _POKE_NM))
    return np.stack(columns, axis=1) / gain[:, None]


def typical_spots(
    configuration: LoopConfiguration,
    sensor: ShackHartmann,
    mirror: DeformableMirror,
    atmosphere: MovingLayers,
    reconstructor: Floats,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return spots as in the loop, all displaced by +0.25 px in x and y, and by -0.25 px.

    Wavefronts are those of the turbulence before the run. In closed loop the mirror corrects the wavefront of
    `delay_frames` earlier.

    Returns
    -------
    tuple of two arrays, (wavefronts, n, pixels, pixels)
    """
    pairs = []
    control = configuration.control
    for number in range(1, _DITHER_WAVEFRONTS + 1):
        time = -_DITHER_STEP_S * number
        wavefront = atmosphere.wavefront_nm(time)
        if control.mode == CLOSED:
            earlier = atmosphere.wavefront_nm(time - control.delay_frames / control.frame_rate_hz)
            wavefront = wavefront - mirror.wavefront_nm(reconstructor @ sensor.mean_slopes_px(earlier))
        pairs.append([sensor.spots(wavefront, sign * _DITHER_PX) for sign in (1.0, -1.0)])
    up, down = (np.stack(spots) for spots in zip(*pairs, strict=True))
    return up, down


def mean_flux(
    pipeline: SlopePipeline,
    sensor: ShackHartmann,
    detector: Detector,
    photons: float,
    spots: tuple[NDArray[np.float32], NDArray[np.float32]],
    seed: int,
) -> MeanFlux:
    """Return the mean flux of every sub-aperture, from frames of `typical_spots` at the run's own flux."""
    frames = []
    for number, image in enumerate(spots[0]):
        rng = np.random.default_rng([seed, number, 5])
        frames.append(detector.expose(sensor.frame(image) * photons, rng))
    return MeanFlux(pipeline(np.stack(frames)).flux)


def centroid_gain(
    pipeline: SlopePipeline,
    sensor: ShackHartmann,
    detector: Detector,
    photons: float,
    spots: tuple[NDArray[np.float32], NDArray[np.float32]],
    seed: int,
) -> float:
    """Return the slope that a pipeline measures for a displacement of 1 px, at the run's own flux.

    From `typical_spots` with the camera's noise; sub-apertures that could not be measured count as they do
    in the loop, as 0. At least 0.05: less cannot be distinguished from none.
    """
    total = 0.0
    for displaced, sign in zip(spots, (1.0, -1.0), strict=True):
        for number, image in enumerate(displaced):
            rng = np.random.default_rng([seed, number, 3])
            frame = detector.expose(sensor.frame(image) * photons, rng)
            total += sign * float(pipeline(frame).vector.mean(dtype=np.float64))
    return max(_SMALLEST_GAIN, total / (2 * _DITHER_PX * len(spots[0])))


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
    return replace(
        configuration, name="-", atmosphere=Atmosphere(), camera=camera, control=kept, run=RunLength()
    )


def without_flux(configuration: LoopConfiguration) -> LoopConfiguration:
    """Return the configuration without values that do not affect the wavefronts, so that these are kept."""
    control = ControlParameters(**{name: getattr(configuration.control, name) for name in _OF_AIR})
    camera = Camera(photons_per_subaperture=1.0)
    return replace(configuration, name="-", camera=camera, control=control, run=RunLength())


@lru_cache(maxsize=2)
def atmosphere_of(configuration: LoopConfiguration, seed: int, realisation: int) -> MovingLayers:
    """Return the atmosphere of a configuration `without_flux` (cached)."""
    return make_atmosphere(configuration, seed, realisation)


@lru_cache(maxsize=2)
def _prepared(configuration: LoopConfiguration) -> LoopOptics:
    pupil = make_pupil(configuration)
    sensor, mirror = make_sensor(configuration, pupil), make_mirror(configuration, pupil)
    check_controllable(mirror.commands, 2 * len(sensor.layout))
    interaction = interaction_matrix(sensor, mirror)
    reconstructor = make_reconstructor(interaction, configuration.control.largest_condition)
    return LoopOptics(pupil, sensor, mirror, interaction, reconstructor)
