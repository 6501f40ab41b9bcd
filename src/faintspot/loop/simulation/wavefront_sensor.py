"""Pupil, mirrors, and Shack-Hartmann sensor: flux on the camera from the wavefront."""

import math
from dataclasses import dataclass
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError, MissingExtraError
from faintspot.loop.simulation.configuration import LoopConfiguration, blur_px
from faintspot.slopes.sensor.layout import Layout

_SUPERSAMPLING = 8


@dataclass(frozen=True, eq=False)
class PupilAmplitude:
    """Amplitude on (n, n) points that tile the square around the pupil."""

    amplitude: NDArray[np.float32]
    """Fraction of each point's area in the pupil."""
    width_m: float
    """Side of the square that the points tile."""

    @property
    def points(self) -> int:
        """Number of points across the pupil."""
        return len(self.amplitude)

    @property
    def spacing_m(self) -> float:
        """Distance between points [m]."""
        return self.width_m / self.points

    def rms(self, wavefront: NDArray[np.floating]) -> float:
        """Return the rms of a wavefront (n, n) over the pupil, without piston, in the wavefront's unit."""
        weights = self.amplitude / self.amplitude.sum()
        mean = float(np.vdot(weights, wavefront))
        return float(np.sqrt(max(0.0, float(np.vdot(weights, wavefront * wavefront)) - mean**2)))

    def field(self, wavefront_nm: NDArray[np.floating], wavelength_m: float) -> NDArray[np.complex64]:
        """Return the complex amplitude (n, n) of a wavefront at a wavelength."""
        phase = (wavefront_nm * np.float32(2e-9 * np.pi / wavelength_m)).astype(np.float32)
        field = np.empty(phase.shape, np.complex64)
        np.cos(phase, out=field.real)
        np.sin(phase, out=field.imag)
        field *= self.amplitude
        return field

    def strehl(self, field: NDArray[np.complex64]) -> float:
        """Return the Strehl ratio on axis: |sum A exp(i phi)|^2 / (sum A)^2."""
        return float(abs(field.sum(dtype=np.complex128)) ** 2 / self.amplitude.sum(dtype=np.float64) ** 2)


def require_hcipy(purpose: str) -> ModuleType:
    """Return the module hcipy.

    Raises
    ------
    MissingExtraError
        When it is not installed.
    """
    try:
        import hcipy
    except ImportError:
        raise MissingExtraError("hcipy", "loop", purpose) from None
    module: ModuleType = hcipy
    return module


def make_pupil(configuration: LoopConfiguration) -> PupilAmplitude:
    """Return the pupil of a configuration, sampled for its sensor."""
    hcipy = require_hcipy("the closed loop")
    telescope = configuration.telescope
    aperture = hcipy.make_obstructed_circular_aperture(telescope.diameter_m, telescope.obstruction)
    grid = pupil_grid(configuration)
    amplitude = hcipy.evaluate_supersampled(aperture, grid, _SUPERSAMPLING).shaped
    return PupilAmplitude(np.ascontiguousarray(amplitude, np.float32), configuration.width_m)


def pupil_grid(configuration: LoopConfiguration) -> object:
    """Return HCIPy's grid of the pupil's points, m."""
    points = configuration.sensor.subapertures * configuration.sensor.samples
    hcipy = require_hcipy("the closed loop")
    grid: object = hcipy.make_pupil_grid(points, configuration.width_m)
    return grid


_LEAST_POWER = 0.1  # of an influence function, that must be in the pupil for the actuator to be used
_CUTOFF = 2.5  # actuators, at which an influence function ends: below 1e-5 of its height


@dataclass(frozen=True, eq=False)
class DeformableMirror:
    """Influence functions of the used actuators, then tip and tilt where there is a mirror for them."""

    influence: Any
    """Sparse (points^2, actuators): wavefront in nm for a command of 1 nm."""
    tilts: NDArray[np.float32]
    """(0 or 2, points, points): wavefront of tip and tilt, 1 nm rms over the pupil for a command of 1 nm."""
    points: int

    @property
    def commands(self) -> int:
        """Number of commands."""
        return int(self.influence.shape[1]) + len(self.tilts)

    def wavefront_nm(self, commands: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return the wavefront that the mirror adds, (points, points)."""
        actuators = self.influence.shape[1]
        command = np.asarray(commands, np.float32)
        surface: NDArray[np.float32] = (self.influence @ command[:actuators]).reshape(
            self.points, self.points
        )
        for tilt, amount in zip(self.tilts, command[actuators:], strict=True):
            surface = surface + amount * tilt
        return surface

    def matrix(self) -> NDArray[np.float32]:
        """Return the wavefronts of all commands, (points^2, commands)."""
        columns: NDArray[np.float32] = np.hstack(
            [self.influence.toarray(), self.tilts.reshape(len(self.tilts), self.points**2).T]
        )
        return columns


def make_mirror(configuration: LoopConfiguration, pupil: PupilAmplitude) -> DeformableMirror:
    """Return the mirror of a configuration: Gaussian influence functions of HCIPy, one for each actuator.

    Actuators with less than a tenth of their influence function's power in the pupil are left out.
    """
    hcipy = require_hcipy("the closed loop")
    across = configuration.mirror.actuators or configuration.sensor.subapertures + 1
    pitch = configuration.width_m / (across - 1)
    basis = hcipy.make_gaussian_influence_functions(
        pupil_grid(configuration), across, pitch, configuration.mirror.crosstalk, _CUTOFF
    )
    influence = basis.transformation_matrix.tocsc()
    # Power relative to a whole influence function's: half of that of an actuator at the edge is off the grid.
    power = influence.multiply(influence)
    inside = pupil.amplitude.ravel() @ power
    used = inside >= _LEAST_POWER * np.asarray(power.sum(axis=0)).max()
    line = (np.arange(pupil.points) + 0.5) / pupil.points - 0.5
    tilts = np.array(
        [np.broadcast_to(line, (pupil.points,) * 2), np.broadcast_to(line[:, None], (pupil.points,) * 2)]
    )
    tilts = np.stack([tilt / pupil.rms(tilt) for tilt in tilts]).astype(np.float32)
    return DeformableMirror(
        influence[:, np.flatnonzero(used)].astype(np.float32).tocsr(),
        tilts if configuration.mirror.tip_tilt else tilts[:0],
        pupil.points,
    )


Floats = NDArray[np.float32]


class ImageAxis(NamedTuple):
    """One axis of a lenslet's image."""

    transform: NDArray[np.complex64]
    """Fourier transform to samples of the image, (image samples, samples)."""
    to_pixels: Floats
    """From image samples to pixels, (pixels, image samples)."""


@dataclass(frozen=True, eq=False)
class ShackHartmann:
    """Lenslets behind the pupil.

    Each lenslet images the field of its own square of points (Fraunhofer), so that turbulence inside it
    speckles its spot; light does not stray into neighbours' windows. All frames hold the flux of the whole
    exposure, with the wavefront of its middle.
    """

    layout: Layout
    illumination: NDArray[np.float64]
    """Illuminated fraction of each sub-aperture, (n,)."""
    amplitude: Floats
    """(n, samples, samples)"""
    wavelength_m: float
    px_per_nm: float
    """Displacement of a spot [px] for a tilt of 1 nm across the sub-aperture."""
    image_y: ImageAxis
    image_x: ImageAxis
    points: int
    """Number of points across the pupil."""

    def lenslets(self, wavefront: NDArray[np.floating]) -> Floats:
        """Return the parts of a wavefront (n, n) in illuminated sub-apertures, (n, samples, samples)."""
        samples = self.amplitude.shape[-1]
        across = len(wavefront) // samples
        squares = wavefront.reshape(across, samples, across, samples).swapaxes(1, 2)
        cells = self.layout.cells
        part: Floats = np.ascontiguousarray(squares[cells[:, 0], cells[:, 1]], np.float32)
        return part

    def spots(self, wavefront_nm: NDArray[np.floating], displacement_px: float = 0.0) -> Floats:
        """Return the flux of every spot, (n, pixels, pixels); 1 for a fully illuminated lenslet.

        Parameters
        ----------
        wavefront_nm : (n, n) array
        displacement_px : float
            How far all spots are moved, in x and in y, by tilting the wavefront.
        """
        phase = self.lenslets(wavefront_nm) * np.float32(2e-9 * np.pi / self.wavelength_m)
        if displacement_px:
            phase += self._tilt(displacement_px)
        phase, lit = (np.ascontiguousarray(part.transpose(1, 2, 0)) for part in (phase, self.amplitude))
        amplitude = _both_axes(self.image_y.transform, _field(phase, lit), self.image_x.transform)
        intensity = amplitude.real**2 + amplitude.imag**2
        images = _both_axes(self.image_y.to_pixels, intensity, self.image_x.to_pixels)
        return np.ascontiguousarray(images.transpose(2, 0, 1))

    def frame(self, spots: Floats) -> NDArray[np.float64]:
        """Return a camera frame with the spots in their windows."""
        frame = np.zeros(self.layout.frame_shape)
        frame[self.layout.window_pixels] = spots
        return frame

    def mean_slopes_px(self, wavefront_nm: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the spot displacements by the mean gradient, all x, then all y, (2 n,) px.

        The mean over the lit part of each sub-aperture, of differences between neighbouring points.
        """
        part, amplitude = self.lenslets(wavefront_nm).astype(np.float64), self.amplitude
        slopes = []
        for axis in (2, 1):
            low, high = (
                np.take(amplitude, range(start, amplitude.shape[axis] - 1 + start), axis) for start in (0, 1)
            )
            weight = low * high
            rise = np.diff(part, axis=axis) * amplitude.shape[axis]
            slopes.append((weight * rise).sum(axis=(1, 2)) / weight.sum(axis=(1, 2)))
        vector: NDArray[np.float64] = np.concatenate(slopes) * self.px_per_nm
        return vector

    def _tilt(self, displacement_px: float) -> Floats:
        samples = self.amplitude.shape[-1]
        line = (np.arange(samples) + 0.5) / samples - 0.5
        rise = displacement_px / self.px_per_nm * 2e-9 * np.pi / self.wavelength_m
        return np.asarray(rise * (line + line[:, None]), np.float32)


def make_sensor(configuration: LoopConfiguration, pupil: PupilAmplitude) -> ShackHartmann:
    """Return the sensor of a configuration.

    Raises
    ------
    InputError
        When no sub-aperture is lit.
    """
    sensor = configuration.sensor
    samples, across, pixels = sensor.samples, sensor.subapertures, sensor.pixels
    squares = pupil.amplitude.reshape(across, samples, across, samples).swapaxes(1, 2)
    illumination = squares.mean(axis=(2, 3), dtype=np.float64)
    cells = np.argwhere(illumination >= sensor.least_illumination)
    if not len(cells):
        raise InputError(
            f"telescope.diameter_m = {configuration.telescope.diameter_m:g}, sensor.subapertures = {across}: "
            f"no sub-aperture has {sensor.least_illumination:g} of its area in the pupil"
        )
    layout = Layout((across * pixels,) * 2, (pixels, pixels), cells * pixels, cells=cells, pitch_px=pixels)
    width = configuration.spot_width_px
    return ShackHartmann(
        layout,
        illumination[cells[:, 0], cells[:, 1]],
        np.ascontiguousarray(squares[cells[:, 0], cells[:, 1]], np.float32),
        sensor.wavelength_m,
        1e-9 / configuration.subaperture_m / configuration.pixel_scale_rad,
        _image_axis(pixels, width, samples, 0.0),
        _image_axis(pixels, width, samples, blur_px(configuration)),
        across * samples,
    )


def _image_axis(pixels: int, width_px: float, samples: int, blur_px: float) -> ImageAxis:
    """Return one axis of an image.

    Gauss-Legendre samples in each pixel; with a blur, pixels beside the window shine into it.
    """
    nodes, weights = np.polynomial.legendre.leggauss(1 + math.ceil(2 / width_px))
    margin = math.ceil(3 * blur_px)
    centres = np.arange(-margin, pixels + margin) - (pixels - 1) / 2
    samples_px = (centres[:, None] + nodes / 2).ravel()
    angle = samples_px / width_px  # in lambda / d
    line = (np.arange(samples) + 0.5) / samples - 0.5
    square = np.sinc(angle / samples) / samples  # each point is a square of constant phase
    transform = np.exp(-2j * np.pi * np.outer(angle, line)) * square[:, None]
    weight = np.tile(weights / 2, len(centres)) / width_px
    window = np.arange(pixels) - (pixels - 1) / 2
    if blur_px:
        from scipy.special import ndtr

        edges = (np.concatenate([window - 0.5, window[-1:] + 0.5])[:, None] - samples_px) / blur_px
        to_pixels = np.diff(ndtr(edges), axis=0) * weight
    else:
        to_pixels = np.where(np.abs(samples_px - window[:, None]) < 0.5, weight, 0.0)
    return ImageAxis(transform.astype(np.complex64), to_pixels.astype(np.float32))


def _field(phase: Floats, amplitude: Floats) -> NDArray[np.complex64]:
    """Return the complex amplitude."""
    field = np.empty(phase.shape, np.complex64)
    np.multiply(np.cos(phase), amplitude, out=field.real)
    np.multiply(np.sin(phase), amplitude, out=field.imag)
    return field


def _both_axes(left: Any, images: Any, right: Any) -> Any:
    """Return left @ image @ right.T for each of the images (ny, nx, n), as a few large products."""
    ny, nx, n = images.shape
    half = (left @ images.reshape(ny, nx * n)).reshape(len(left), nx, n)
    return np.matmul(right, half)
