"""Loops of OOPAO: atmosphere, telescope, sensor, noise and mirror are OOPAO's, slopes by `window`."""

import contextlib
import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import faintspot as fs
from benchmarks.loops.foreign.base import IMAGING_M, Control, Floats, SteppedLoop
from faintspot.loop.control.identification.vibrations import Vibration
from faintspot.loop.slope_covariance import ARCSEC

_R0_M = 0.25  # of the turbulence that is simulated; another r0 scales it
POKE_M = 2e-8
CHANGED_AFTER = 700
"""Frames before the winds of a `ChangingLoop` change."""
_TRUNCATED = 4
"""Singular values that OOPAO's reconstructor leaves out."""


@dataclass(frozen=True)
class OopaoCase:
    """Telescope, star and turbulence."""

    name: str
    r0_m: float = 0.25
    flux_e: float = 20.0
    read_noise_e: float = 3.0
    width_px: float = 2.4
    vibration_nm: float = 0.0
    delay_frames: int = 2
    lenslets: int = 7
    lenslet_px: int = 12
    diameter_m: float = 4.2
    rate_hz: float = 250.0
    fault: str = ""
    """Change since the matrix was measured: "moved" (0.3 sub-apertures and 5 degrees), "dead" (one actuator),
    "columns" (gains of commands between 0.5 and 1.5)."""
    is_modal: bool = False
    """Whether faintspot is not told the geometry."""


class OopaoLoop(SteppedLoop):
    """Loop of OOPAO."""

    winds = [(6.0, 20.0), (9.0, 80.0), (14.0, 150.0), (22.0, 250.0)]  # noqa: RUF012

    def __init__(self, case: OopaoCase, folder: Path) -> None:
        from OOPAO.calibration.CalibrationVault import CalibrationVault
        from OOPAO.DeformableMirror import DeformableMirror
        from OOPAO.ShackHartmann import ShackHartmann
        from OOPAO.Source import Source
        from OOPAO.Telescope import Telescope

        from faintspot.adapters import oopao

        super().__init__(folder, f"oopao-{case.diameter_m:g}")
        self._case, self.name, self.rate_hz = case, f"oopao-{case.name}", case.rate_hz
        self.delay_frames, self.subaperture_m = case.delay_frames, case.diameter_m / case.lenslets
        self.r0_m, self.is_modal = case.r0_m, case.is_modal
        points = case.lenslets * case.lenslet_px
        with quiet():
            self._telescope = Telescope(
                resolution=points,
                diameter=case.diameter_m,
                samplingTime=1 / case.rate_hz,
                centralObstruction=0.25,
            )
            self._star = Source(optBand="R", magnitude=10)
            self._star * self._telescope
            self._wfs = ShackHartmann(
                nSubap=case.lenslets, telescope=self._telescope, lightRatio=0.5, shannon_sampling=True
            )
            self._mirror = DeformableMirror(self._telescope, nSubap=case.lenslets, mechCoupling=0.35)
            self._star**self._telescope * self._wfs
            self._star.nPhoton *= case.flux_e * self._wfs.nSignal / 2 / self._wfs.cam.frame.sum()
            self._star**self._telescope * self._wfs
            settings = fs.Settings("window", flux_e=case.flux_e, window_fwhm_px=case.width_px)
            camera = fs.Calibration(dark=0.0, read_noise_e=case.read_noise_e)
            self._wfs.cam.photonNoise, self._wfs.cam.readoutNoise = False, 0
            oopao.attach(self._wfs, settings, camera, psf=fs.PSF.analytic("diffraction", size=1.0))
        self._pupil, self._factors = self._telescope.pupil.astype(bool), np.ones(self._mirror.nValidAct)
        self.cells = np.argwhere(self._wfs.valid_subapertures)
        pokes, self._tilt_of_signal = self._calibrate()
        self.interaction = pokes
        self.unit_arcsec = points / case.diameter_m / self._tilt_of_signal / ARCSEC
        with quiet():
            vault = CalibrationVault(pokes, nTrunc=_TRUNCATED)
        self.own = {} if case.fault else {"OOPAO's truncated inverse": np.asarray(vault.Mtrunc)}
        self._break()

    def _break(self) -> None:
        """Change the mirror as the case says."""
        from OOPAO.DeformableMirror import DeformableMirror
        from OOPAO.MisRegistration import MisRegistration

        actuators = self._mirror.nValidAct
        if self._case.fault == "dead":
            self._factors[actuators // 2 + 3] = 0.0
        elif self._case.fault == "columns":
            self._factors = np.random.default_rng(0).uniform(0.5, 1.5, actuators)
        elif self._case.fault == "moved":
            with quiet():
                change = MisRegistration()
                change.shiftX, change.shiftY = 0.3 * self.subaperture_m * np.array([np.cos(1), np.sin(1)])
                change.rotationAngle = 5.0
                self._mirror = DeformableMirror(
                    self._telescope, nSubap=self._case.lenslets, mechCoupling=0.35, misReg=change
                )

    def _calibrate(self) -> tuple[Floats, float]:
        """Return the interaction matrix, and the gain of slopes relative to true gradients."""
        columns, gradients = [], []
        for poke in POKE_M * np.eye(self._mirror.nValidAct):
            signals = [self._measured(command) for command in (poke, -poke)]
            gradients.append(-2 * self._gradients())
            columns.append((signals[0] - signals[1]) / (2 * POKE_M))
        lit = self._fully_lit()
        matrix, true = np.array(columns).T, np.array(gradients).T / (2 * POKE_M)
        return matrix, float((matrix[lit] * true[lit]).sum() / np.square(true[lit]).sum())

    def _measured(self, command: Floats, path_m: Any = 0.0) -> Floats:
        from OOPAO.OPD_map import OPD_map

        self._mirror.coefs = self._factors * command
        screen = OPD_map(np.zeros(self._pupil.shape) + path_m)
        self._star**self._telescope * screen * self._mirror * self._wfs
        return np.array(self._wfs.signal)

    def _lenslets(self, values: Any) -> Floats:
        """Return the mean over each valid lenslet."""
        side, number = self._case.lenslet_px, self._case.lenslets
        means = np.asarray(values, np.float64).reshape(number, side, number, side).mean(axis=(1, 3))
        return np.asarray(means[tuple(self.cells.T)])

    def _fully_lit(self) -> NDArray[np.bool_]:
        return np.tile(self._lenslets(self._pupil) == 1, 2)

    def _gradients(self) -> Floats:
        """Return mean gradients of the wavefront of the latest frame, x and y."""
        path_m = self._star.phase * self._star.wavelength / (2 * np.pi)
        return np.concatenate([self._lenslets(np.gradient(path_m, axis=axis)) for axis in (1, 0)])

    def true_gain(self, control: Control, seed: int, frames: int) -> float:
        """See `ForeignLoop`."""
        pairs: list[tuple[Floats, Floats]] = []
        self.run(_Watched(control, self._gradients, pairs), seed, frames)
        lit = self._fully_lit()
        slopes, true = (np.array(values)[50:, lit] for values in zip(*pairs, strict=True))
        return float((slopes * true).sum() / np.square(true).sum() / self._tilt_of_signal)

    def simulated(self, seed: int, frames: int) -> NDArray[np.float32]:
        """See `SteppedLoop`."""
        from OOPAO.Atmosphere import Atmosphere

        paths_m = np.empty((frames, *self._pupil.shape), np.float32)
        speeds, directions = (list(values) for values in zip(*self.winds, strict=True))
        with quiet():
            layers = Atmosphere(
                self._telescope,
                r0=_R0_M,
                L0=25,
                windSpeed=speeds,
                fractionalR0=[0.45, 0.25, 0.15, 0.15],
                windDirection=directions,
                altitude=[0, 100, 200, 300],
            )
            layers.initializeAtmosphere(self._telescope)
            layers.generateNewPhaseScreen(seed)
            for path_m in paths_m:
                layers.update()
                self._star**layers * self._telescope
                path_m[:] = self._star.OPD
        return paths_m

    def paths_m(self, seed: int, frames: int) -> NDArray[np.float32]:
        """Return turbulence of the case's r0, with its vibration."""
        scale = np.float32((_R0_M / self._case.r0_m) ** (5 / 6))
        paths_m: NDArray[np.float32] = scale * super().paths_m(seed, frames)
        if self._case.vibration_nm:
            points = self._pupil.shape[0]
            tip = np.broadcast_to(np.linspace(-1, 1, points, dtype=np.float32), self._pupil.shape)
            tip = tip / np.sqrt(np.mean(tip**2)) * self._pupil
            paths_m += vibration(seed, frames, self.rate_hz)[:, None, None] * (
                np.float32(self._case.vibration_nm * 1e-9) * tip
            )
        return paths_m

    def wavefronts(self, paths_m: Any) -> Floats:
        """Return wavefronts that are NaN outside the pupil."""
        return np.where(self._pupil, paths_m, np.float32(np.nan))

    def begin(self, seed: int) -> None:
        """See `SteppedLoop`."""
        camera = self._wfs.cam
        camera.photonNoise, camera.readoutNoise = True, self._case.read_noise_e
        camera.random_state_photon_noise = np.random.RandomState(seed)
        camera.random_state_readout_noise = np.random.RandomState(seed + 1000)

    def image(self, path_m: NDArray[np.float32]) -> Floats:
        """Return the frame of a wavefront without noise; lenslets moved, as x and y are swapped in them."""
        self._wfs.cam.photonNoise, self._wfs.cam.readoutNoise = False, 0
        self._measured(np.zeros(self._mirror.nValidAct), path_m)
        frame, number = np.array(self._wfs.cam.frame), self._case.lenslets
        side = len(frame) // number
        return frame.reshape(number, side, number, side).transpose(2, 1, 0, 3).reshape(frame.shape)

    def frame(self, path_m: NDArray[np.float32], command: Floats) -> tuple[Floats, float]:
        """See `SteppedLoop`."""
        slopes = self._measured(command, path_m)
        phase = self._star.phase[self._pupil] * self._star.wavelength / IMAGING_M
        return slopes, float(abs(np.exp(1j * phase).mean()) ** 2)


class ChangingLoop(OopaoLoop):
    """Loop whose winds become faster by 1.6 and turn by 40 degrees after 700 frames, once they may."""

    def paths_m(self, seed: int, frames: int) -> NDArray[np.float32]:
        """See `SteppedLoop`."""
        if not self.is_changing or frames <= CHANGED_AFTER:
            return super().paths_m(seed, frames)
        first, winds, atmosphere = super().paths_m(seed, CHANGED_AFTER), self.winds, self._atmosphere
        self.winds = [(1.6 * speed, direction + 40) for speed, direction in winds]
        self._atmosphere = f"{atmosphere}-changed"
        try:
            return np.concatenate([first, super().paths_m(seed + 100, frames - CHANGED_AFTER)])
        finally:
            self.winds, self._atmosphere = winds, atmosphere


class _Watched:
    """Control that notes slopes and true gradients."""

    def __init__(self, control: Control, truth: Any, pairs: list[tuple[Floats, Floats]]) -> None:
        self._control, self._truth, self._pairs = control, truth, pairs

    def __call__(self, slopes: Floats) -> Floats:
        self._pairs.append((slopes, self._truth()))
        return self._control(slopes)


def vibration(seed: int, frames: int, rate_hz: float) -> NDArray[np.float32]:
    """Return a line of 45 Hz of unit rms."""
    line = Vibration("tip", 45.0, 0.005, 1.0, 0.0, 0.0)
    (one, two), driving = line.recursion(rate_hz), np.sqrt(line.driving_variance(rate_hz))
    values = [0.0, 0.0]
    for noise in np.random.default_rng([seed, 45]).standard_normal(frames + 2000):
        values.append(one * values[-1] + two * values[-2] + driving * noise)
    return np.array(values[-frames:], np.float32)


def quiet() -> contextlib.redirect_stdout[io.StringIO]:
    return contextlib.redirect_stdout(io.StringIO())
