"""Loop of HCIPy: its example's telescope, sensor and mirror behind three of its infinite layers."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import faintspot as fs
from benchmarks.loops.foreign.base import IMAGING_M, Floats, SteppedLoop
from benchmarks.loops.foreign.specula import example
from faintspot.loop.slope_covariance import ARCSEC

_SHARES = 0.5, 0.3, 0.2
_TILT_RAD = 1e-7


class HcipyLoop(SteppedLoop):
    """Loop of HCIPy, 7 x 7 lenslets, slopes by `window`."""

    rate_hz, delay_frames, r0_m = 250.0, 2, 0.2
    winds = [(6.0, 20.0), (12.0, 110.0), (20.0, 230.0)]  # noqa: RUF012

    def __init__(self, flux_e: float, folder: Path) -> None:
        from faintspot.adapters.hcipy import SlopeEstimator

        super().__init__(folder, "hcipy")
        self._example = system = example("hcipy_loop")
        self.name, self._photons = f"hcipy-{flux_e:g}", system.photons * flux_e / system.FLUX_E
        self.subaperture_m = system.DIAMETER_M / 7
        settings = fs.Settings("window", flux_e=flux_e, window_fwhm_px=4.0)
        camera = fs.Calibration(dark=0.0, read_noise_e=system.READ_NOISE_E)
        psf = fs.PSF.analytic("diffraction", size=1.0)
        self._estimator = SlopeEstimator(
            system.sensor.mla_grid,
            system.sensor.mla_index,
            system.illuminated,
            settings=settings,
            calibration=camera,
            psf=psf,
        )
        commands, slopes = system.mirror.num_actuators, []
        with self._estimator.calibrating():
            for poke_m in 3e-8 * np.vstack([np.eye(commands), -np.eye(commands)]):
                system.mirror.actuators = poke_m
                slopes.append(self._slopes(system.image(system.noiseless, 0 * system.pupil, self._photons)))
            system.mirror.flatten()
            tilts = [
                self._slopes(system.image(system.noiseless, sign * _TILT_RAD * system.grid.x, self._photons))
                for sign in (1, -1)
            ]
        plus, minus = np.split(np.array(slopes), 2)
        self._flat = np.mean(slopes, axis=0)
        of_tilt = (tilts[0] - tilts[1])[: len(self._flat) // 2].mean() / 2
        self.unit_arcsec = abs(_TILT_RAD / of_tilt) / ARCSEC
        self.interaction = (plus - minus).T / 6e-8
        self.own = {"HCIPy's Tikhonov inverse": system.hcipy.inverse_tikhonov(self.interaction, rcond=0.03)}
        self.cells = self._cells()

    def _cells(self) -> NDArray[np.int64]:
        grid = self._example.sensor.mla_grid
        used = np.asarray(self._example.illuminated) > 0
        x, y = np.asarray(grid.x)[used], np.asarray(grid.y)[used]
        pitch = np.diff(np.unique(x.round(9))).min()
        rows, columns = ((values - values.min()) / pitch for values in (y, x))
        return np.asarray(np.rint(np.stack([rows, columns], axis=1)), np.int64)

    def _slopes(self, image: Any) -> Floats:
        return np.asarray(self._estimator.estimate([image]), np.float64).ravel()

    def simulated(self, seed: int, frames: int) -> NDArray[np.float32]:
        """See `SteppedLoop`."""
        system = self._example
        strength = system.hcipy.Cn_squared_from_fried_parameter(self.r0_m, 500e-9)
        layers = [
            system.hcipy.InfiniteAtmosphericLayer(
                system.grid,
                share * strength,
                25.0,
                speed * np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))]),
                seed=10 * seed + number,
            )
            for number, (share, (speed, angle)) in enumerate(zip(_SHARES, self.winds, strict=True))
        ]
        paths_m = np.zeros((frames, system.grid.size), np.float32)
        for number, path_m in enumerate(paths_m):
            for layer in layers:
                layer.t = number / self.rate_hz
                path_m += (layer.phase_for(IMAGING_M) * IMAGING_M / (2 * np.pi)).astype(np.float32)
        return paths_m

    def image(self, path_m: NDArray[np.float32]) -> Floats:
        """Return the frame of a wavefront without noise."""
        frame = self._example.image(self._example.noiseless, path_m, self._photons)
        return np.asarray(frame.shaped, np.float64)

    def wavefronts(self, paths_m: Any) -> Floats:
        """Return wavefronts that are NaN outside the pupil."""
        lit = np.asarray(self._example.pupil) > 0.5
        return np.where(lit, paths_m, np.nan).reshape(len(paths_m), *self._example.grid.shape)

    def begin(self, seed: int) -> None:
        """See `SteppedLoop`."""
        np.random.seed(seed)  # noqa: NPY002 - HCIPy's detectors draw from this one

    def _strehl(self, path_m: NDArray[np.float32], command: Floats) -> float:
        """Send a command, and return the Strehl ratio behind the mirror."""
        system = self._example
        system.mirror.actuators = command
        residual = path_m + system.mirror.opd
        field = np.average(np.exp(2j * np.pi / IMAGING_M * residual), weights=system.pupil)
        return float(np.abs(field) ** 2)

    def frame(self, path_m: NDArray[np.float32], command: Floats) -> tuple[Floats, float]:
        """See `SteppedLoop`."""
        ratio, system = self._strehl(path_m, command), self._example
        return self._slopes(system.image(system.noisy, path_m, self._photons)) - self._flat, ratio
