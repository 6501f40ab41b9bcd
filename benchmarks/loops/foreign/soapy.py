"""Loop of soapy: 4.2 m, 7 x 7 lenslets behind three of its infinite screens, slopes by `window`."""

import contextlib
import io
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import faintspot as fs
from benchmarks.loops.foreign.base import IMAGING_M, Floats, SteppedLoop
from faintspot.adapters.base import ToolSlopes
from faintspot.loop.slope_covariance import ARCSEC

_READ_NOISE_E = 1.0
_LENSLET_M, _SUBAPERTURE_PX, _FIELD_ARCSEC = 0.6, 12, 1.8
_SENSING_M = 0.65e-6
_TILT_ARCSEC = 0.02
_SYSTEM = """
simName:
pupilSize: 84
nGS: 1
nDM: 1
nSci: 1
nIters: 10
loopTime: 0.004
threads: 1
Atmosphere:
  {{scrnNo: 3, scrnHeights: [0, 0, 0], scrnStrengths: [0.5, 0.3, 0.2], windDirs: {directions},
  windSpeeds: {speeds}, r0: {r0_m}, L0: [25, 25, 25], wholeScrnSize: 256, infinite: true}}
Telescope: {{telDiam: 4.2, obsDiam: 1.2, mask: circle}}
WFS:
  0: {{type: ShackHartmann, GSMag: {magnitude}, GSPosition: [0, 0], GSHeight: 0, wavelength: {sensing_m},
    nxSubaps: 7, pxlsPerSubap: {pixels}, subapFOV: {field}, subapThreshold: 0.5, photonNoise: true,
    eReadNoise: {read_noise}, propagationMode: Geometric, exposureTime: 0.004}}
DM:
  0: {{type: GaussStack, nxActuators: 8, svdConditioning: 0.05}}
Reconstructor: {{type: MVM, svdConditioning: 0.05, imatValue: 20}}
Science:
  0: {{type: PSF, wavelength: {imaging_m}, FOV: 1.0, pxls: 32, position: [0, 0]}}
"""


class SoapyLoop(SteppedLoop):
    """Loop of soapy."""

    rate_hz, delay_frames, r0_m, sign = 250.0, 2, 0.2, -1.0
    subaperture_m = _LENSLET_M
    winds = [(6.0, 0.0), (12.0, 90.0), (20.0, 270.0)]  # noqa: RUF012

    def __init__(self, flux_e: float, folder: Path) -> None:
        super().__init__(folder, "soapy")
        self.name = f"soapy-{flux_e:g}"
        magnitude = 12.0
        for _ in range(2):
            self._system = _simulation(self.winds, self.r0_m, magnitude, seed=1)
            self._sensor = self._system.wfss[0]
            magnitude += 2.5 * np.log10(self._flux_e() / flux_e)
        settings = fs.Settings("window", flux_e=flux_e, window_fwhm_px=3.0)
        camera = fs.Calibration(dark=0.0, read_noise_e=_READ_NOISE_E)
        spot_px = _SENSING_M / _LENSLET_M / (_FIELD_ARCSEC / _SUBAPERTURE_PX * ARCSEC)
        count, psf = int(self._sensor.n_subaps), fs.PSF.analytic(size=spot_px / 2)
        layout = fs.Layout.stacked(count, (_SUBAPERTURE_PX, _SUBAPERTURE_PX))
        _measure_with(self._sensor, ToolSlopes(layout, settings, camera, psf=psf))
        with contextlib.redirect_stdout(io.StringIO()):
            self._system.makeIMat(forceNew=True)
        self.unit_arcsec = self._tilt_arcsec()
        recon = self._system.recon
        self.interaction = np.array(recon.interaction_matrix.T, np.float64)
        self.own = {"soapy's MVM": np.array(recon.control_matrix.T, np.float64)}
        corners = np.asarray(self._sensor.detector_cent_coords)
        self.cells = (corners - corners.min(axis=0)) // _SUBAPERTURE_PX
        self._pupil = np.asarray(self._system.mask) > 0

    def _flux_e(self) -> float:
        """Return the mean electrons of a lenslet."""
        self._sensor.config.photonNoise, self._sensor.config.eReadNoise = False, 0.0
        flat = np.zeros_like(self._system.atmos.scrns)
        self._sensor.frame(flat)
        flux = float(self._sensor.centSubapArrays.sum() / self._sensor.n_subaps)
        self._sensor.config.photonNoise, self._sensor.config.eReadNoise = True, _READ_NOISE_E
        return flux

    def _tilt_arcsec(self) -> float:
        """Return the angle of a unit of the slopes, from a small tilt without noise."""
        screens = np.zeros_like(self._system.atmos.scrns)
        screens[0] += (
            np.arange(screens.shape[-1]) * self._system.atmos.pixel_scale * _TILT_ARCSEC * ARCSEC * 1e9
        )
        slopes = np.array(self._sensor.frame(screens, iMatFrame=True), np.float64).reshape(2, -1)
        return float(_TILT_ARCSEC / np.hypot(*slopes.mean(axis=1)))

    def simulated(self, seed: int, frames: int) -> NDArray[np.float32]:
        """Return the screens of each frame, nm."""
        atmosphere = _simulation(self.winds, self.r0_m, 12.0, seed).atmos
        screens = np.empty((frames, *atmosphere.scrns.shape), np.float32)
        for screen in screens:
            screen[:] = atmosphere.moveScrns()  # always the same array
        return screens

    def image(self, path_m: NDArray[np.float32]) -> Floats:
        """Return the frame of some screens without noise."""
        self._sensor.config.photonNoise, self._sensor.config.eReadNoise = False, 0.0
        self._sensor.frame(np.asarray(path_m, np.float64))
        return np.array(self._sensor.wfsDetectorPlane, np.float64)

    def wavefronts(self, paths_m: Any) -> Floats:
        """Return wavefronts that are NaN outside the pupil, m."""
        total, side = 1e-9 * np.asarray(paths_m).sum(axis=1), self._system.config.sim.pupilSize
        first, margin = (total.shape[-1] - side) // 2, (len(self._pupil) - side) // 2
        lit = self._pupil[margin : margin + side, margin : margin + side]
        return np.where(lit, total[:, first : first + side, first : first + side], np.nan)

    def begin(self, seed: int) -> None:
        """See `SteppedLoop`."""
        np.random.seed(seed + 1000)  # noqa: NPY002 - soapy draws its noise from this one

    def frame(self, path_m: NDArray[np.float32], command: Floats) -> tuple[Floats, float]:
        """See `SteppedLoop`; the paths are soapy's screens."""
        screens, correction = np.asarray(path_m, np.float64), self._system.runDM(command)
        slopes = np.array(self._sensor.frame(screens, correction), np.float64)
        sight = self._system.sciCams[0].los
        sight.frame(screens, correction)
        return slopes, float(abs(np.exp(1j * sight.phase[self._pupil]).mean()) ** 2)


def _measure_with(sensor: Any, tool: ToolSlopes) -> None:
    """Make slopes of a tool the centroider of a sensor, which soapy looks up by name in its module."""

    def centroid(images: Any, threshold: Any = None, ref: Any = None, **_: Any) -> Floats:
        """Return positions as soapy's centroiders do: (2, n) px from the first pixel."""
        config, static = sensor.config, sensor.staticData
        noise_free = bool(sensor.iMat) or not (config.photonNoise or config.eReadNoise)
        # soapy subtracts half a window, so that a centred spot has -1/2, part of the static slopes.
        reference = np.full((2, len(images)), 0.5) + (0.0 if static is None else static)
        found = tool.measure(np.reshape(images, (-1, _SUBAPERTURE_PX)), noise_free=noise_free)
        found = np.where(tool.last.measured, found, reference)
        return np.asarray(found + 0.5 * (_SUBAPERTURE_PX - 1))

    sys.modules[type(sensor).__module__].centroiders.faintspot = centroid
    sensor.config.centMethod = "faintspot"
    sensor.getStatic()


def _simulation(winds: list[tuple[float, float]], r0_m: float, magnitude: float, seed: int) -> Any:
    import soapy

    speeds, directions = (list(values) for values in zip(*winds, strict=True))
    text = _SYSTEM.format(
        directions=directions,
        speeds=speeds,
        r0_m=r0_m,
        magnitude=magnitude,
        sensing_m=_SENSING_M,
        imaging_m=IMAGING_M,
        pixels=_SUBAPERTURE_PX,
        field=_FIELD_ARCSEC,
        read_noise=_READ_NOISE_E,
    )
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        path = Path(folder) / "system.yaml"
        path.write_text(text)
        simulation = soapy.Sim(str(path))
        np.random.seed(seed)  # noqa: NPY002 - soapy draws its screens from this one
        simulation.aoinit()
    return simulation
