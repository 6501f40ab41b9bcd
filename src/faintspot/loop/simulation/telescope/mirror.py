"""Deformable mirror and tip-tilt mirror: wavefront from commands."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import MissingExtraError
from faintspot.loop.simulation.configuration.configuration import LoopConfiguration
from faintspot.slopes.wavefront.zernike import zernike

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

    def zernike(self, wavefront: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return Zernike modes 2 to 11 (Noll) of a wavefront (n, n) over the pupil, in its unit: (10,)."""
        modes: NDArray[np.float32] = self._to_zernike @ wavefront.ravel()
        return modes

    @cached_property
    def _to_zernike(self) -> NDArray[np.float32]:
        """Weighted least-squares fit of piston and the modes, without the row of piston."""
        line = (np.arange(self.points) + 0.5) / self.points - 0.5
        lit = self.amplitude.ravel() > 0.5
        x, y = (coordinate.ravel() for coordinate in np.meshgrid(line, line))
        radius = float(np.hypot(x, y)[lit].max())
        modes = np.stack([zernike(mode, x / radius, y / radius) for mode in range(1, 12)])
        weighted = modes * self.amplitude.ravel()
        return np.linalg.solve(weighted @ modes.T, weighted)[1:].astype(np.float32)

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
