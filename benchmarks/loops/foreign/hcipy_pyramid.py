"""Loops of HCIPy with its modulated pyramid, of which faintspot is told no geometry."""

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.loops.foreign.base import Floats, SteppedLoop
from benchmarks.loops.foreign.hcipy import HcipyLoop
from benchmarks.loops.foreign.oopao import POKE_M, OopaoCase, vibration
from benchmarks.loops.foreign.specula import example

_MODULATION, _POINTS = 3.0, 12
"""Radius of the modulation in wavelengths over the diameter, and points on it."""
_PIXELS, _FIELD, _SAMPLING = 14, 10.0, 3
"""Pixels across a pupil image; radius of the field stop, and points in a wavelength over the diameter."""
_LEAST_FLUX = 0.5  # of the mean of the pixels, that a pixel of the pupil has


class HcipyPyramidLoop(HcipyLoop):
    """Loop of HCIPy with a pyramid.

    Parameters
    ----------
    case : OopaoCase
        Its flux, read noise and vibration; the flux is that of the whole frame.
    folder : Path
    """

    is_modal = True

    def __init__(self, case: OopaoCase, folder: Path) -> None:
        SteppedLoop.__init__(self, folder, "hcipy")
        self._case, self.name, self._photons = case, f"hcipy-pyramid-{case.name}", case.flux_e
        self._example = system = example("hcipy_loop")
        self.subaperture_m, self.unit_arcsec, self.own = system.DIAMETER_M / 7, math.nan, {}
        self.cells = np.zeros((0, 2), np.int64)
        pixels = system.hcipy.make_pupil_grid(2 * _PIXELS, 2 * system.DIAMETER_M)
        pyramid = system.hcipy.PyramidWavefrontSensorOptics(
            system.grid, pixels, wavelength_0=system.SENSING_M, q=_SAMPLING, num_airy=_FIELD
        )
        diameter = 2 * _MODULATION * system.SENSING_M / system.DIAMETER_M
        self._optics = system.hcipy.ModulatedPyramidWavefrontSensorOptics(
            pyramid, diameter, _POINTS, fast_modulation_method=True
        )
        self._noiseless = system.hcipy.NoiselessDetector(pixels)
        self._noisy = system.hcipy.NoisyDetector(pixels, read_noise=case.read_noise_e)
        system.mirror.flatten()
        flat_m = 0 * system.pupil
        flux = self._quarters(self.image(flat_m)).sum(axis=0)
        self._lit, self._flat = flux > _LEAST_FLUX * flux.mean(), np.zeros(1)
        self._photons *= case.flux_e / flux.sum()
        columns = []
        for poke in POKE_M * np.eye(system.mirror.num_actuators):
            signals = []
            for system.mirror.actuators in (poke, -poke):
                signals.append(self._slopes(self.image(flat_m)))
            columns.append((signals[0] - signals[1]) / (2 * POKE_M))
        system.mirror.flatten()
        self._flat = self._slopes(self.image(flat_m))
        self.interaction = np.array(columns).T

    def paths_m(self, seed: int, frames: int) -> NDArray[np.float32]:
        """Return the turbulence of a seed, with the vibration of the case."""
        paths_m: NDArray[np.float32] = super().paths_m(seed, frames)
        if self._case.vibration_nm:
            tip = np.asarray(self._example.grid.x * (self._example.pupil > 0))
            tip *= 1e-9 * self._case.vibration_nm / np.sqrt(np.mean(tip[tip != 0] ** 2))
            paths_m = paths_m + np.outer(vibration(seed, frames, self.rate_hz), tip.astype(np.float32))
        return paths_m

    def image(self, path_m: NDArray[np.float32]) -> Floats:
        """Return the frame of a wavefront without noise."""
        return self._seen(self._noiseless, path_m)

    def _seen(self, detector: Any, path_m: NDArray[np.float32]) -> Floats:
        system = self._example
        phase = 2 * np.pi / system.SENSING_M * path_m
        wavefront = system.hcipy.Wavefront(system.pupil * np.exp(1j * phase), system.SENSING_M)
        wavefront.total_power = self._photons
        modulated = self._optics(system.mirror(wavefront))
        return np.asarray(detector(sum(part.power for part in modulated) / _POINTS).shaped, np.float64)

    @staticmethod
    def _quarters(image: Floats) -> Floats:
        """Return the four pupil images, (4, rows, columns)."""
        return image.reshape(2, _PIXELS, 2, _PIXELS).swapaxes(1, 2).reshape(4, _PIXELS, _PIXELS)

    def _slopes(self, image: Any) -> Floats:
        a, b, c, d = self._quarters(image)[:, self._lit]
        differences = np.concatenate([a + c - b - d, a + b - c - d])
        return np.asarray(differences / np.mean(a + b + c + d) - self._flat)

    def frame(self, path_m: NDArray[np.float32], command: Floats) -> tuple[Floats, float]:
        """See `SteppedLoop`."""
        ratio = self._strehl(path_m, command)
        return self._slopes(self._seen(self._noisy, path_m)), ratio
