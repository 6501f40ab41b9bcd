"""faintspot in an OOPAO closed loop: its slopes beside OOPAO's own, for a faint star.

A 3.6 m telescope, 6x6 lenslets of 10x10 pixels, 22 electrons per lenslet and frame, 250 frames/s, 1 electron
of read noise. One line makes a sensor measure with faintspot (`attach`); OOPAO's references, slopes units and
interaction matrix are then made through it. Every method is tuned on other air than it is judged by.
"""

import contextlib
import io
from functools import cache
from typing import Any

import numpy as np
from loop_table import by_commands, compare
from OOPAO.Atmosphere import Atmosphere
from OOPAO.DeformableMirror import DeformableMirror
from OOPAO.OPD_map import OPD_map
from OOPAO.ShackHartmann import ShackHartmann
from OOPAO.Source import Source
from OOPAO.Telescope import Telescope

import faintspot as fs
from faintspot.adapters import oopao
from faintspot.adapters.base import check_matrix

FLUX_E, READ_NOISE_E, FRAMES, SETTLE, IMAGING_M = 22.0, 1.0, 160, 40, 1.65e-6
GAINS = (0.05, 0.1, 0.2, 0.35)
quiet = contextlib.redirect_stdout(io.StringIO())  # OOPAO says much

# The user's own system, all of it OOPAO's.
with quiet:
    telescope = Telescope(resolution=60, diameter=3.6, samplingTime=1 / 250, centralObstruction=0.2)
    star = Source(optBand="R", magnitude=10)
    star * telescope
    wfs = ShackHartmann(nSubap=6, telescope=telescope, lightRatio=0.5, shannon_sampling=True)
    mirror = DeformableMirror(telescope, nSubap=6, mechCoupling=0.35)
    star**telescope * wfs
    star.nPhoton *= FLUX_E * wfs.nSignal / 2 / wfs.cam.frame.sum()
    star**telescope * wfs
pupil = telescope.pupil.astype(bool)


@cache
def atmosphere(seed: int) -> list[np.ndarray]:
    """Return the optical path difference, m, of every frame."""
    with quiet:
        layer = Atmosphere(
            telescope, r0=0.15, L0=25, windSpeed=[15], fractionalR0=[1], windDirection=[30], altitude=[0]
        )
        layer.initializeAtmosphere(telescope)
        layer.generateNewPhaseScreen(seed)
        paths = []
        for _ in range(FRAMES):
            layer.update()
            star**layer * telescope  # OOPAO updates the path difference when light passes
            paths.append(np.array(star.OPD))
    return paths


class Setup:
    """A way to measure slopes, with the interaction matrix that was made through it."""

    def __init__(
        self, label: str, *, threshold: float = 0.01, fwhm_px: float | None = None, **ours: Any
    ) -> None:
        self.label, self.threshold, self.fwhm_px, self.ours = label, threshold, fwhm_px, ours
        self.predicts = "prior_std_px" in ours
        self.commands = np.zeros(mirror.nValidAct), np.zeros(mirror.nValidAct)
        self.matrix: Any = None

    def __repr__(self) -> str:
        return self.label

    def use(self) -> Any:
        """Let the sensor measure so, and calibrate it."""
        wfs.cam.photonNoise, wfs.cam.readoutNoise = False, 0
        wfs.threshold_cog = self.threshold
        for data in wfs.sh_data.values():
            data.weighting_map = 1
        attached = None
        with quiet:
            if self.ours:
                camera = fs.Calibration(dark=0.0, read_noise_e=READ_NOISE_E)
                psf = fs.PSF.analytic("diffraction", size=1.0)
                predict = None
                if self.predicts and self.matrix is not None:
                    predict = by_commands(self.matrix, lambda: self.commands)
                attached = oopao.attach(wfs, fs.Settings(**self.ours), camera, psf=psf, predict=predict)
            elif self.fwhm_px:
                wfs.set_weighted_centroiding_map(
                    star, is_lgs=False, is_gaussian=True, fwhm_factor=self.fwhm_px
                )
            else:
                wfs.initialize_wfs()
        if self.matrix is None:
            columns = []
            for poke in 2e-8 * np.eye(mirror.nValidAct):
                columns.append((measured(poke) - measured(-poke)) / 4e-8)
            self.matrix = check_matrix("interaction matrix", np.array(columns).T)
            self.control = np.linalg.pinv(self.matrix, rcond=0.1)
            if self.predicts:
                attached.detach()
                return self.use()
        return attached


def measured(commands: np.ndarray, path_m: np.ndarray | float = 0.0) -> np.ndarray:
    """Return OOPAO's signal of a path difference after the mirror."""
    mirror.coefs = commands
    residual = OPD_map(np.zeros_like(telescope.pupil) + path_m)
    star**telescope * residual * mirror * wfs
    return np.array(wfs.signal)


def strehl(setup: Setup, gain: float, seed: int) -> float:
    """Close the loop and return the long-exposure Strehl ratio at 1.65 um; commands are a frame late."""
    attached = setup.use()
    wfs.cam.photonNoise, wfs.cam.readoutNoise = True, READ_NOISE_E
    wfs.cam.random_state_photon_noise = np.random.RandomState(seed)
    wfs.cam.random_state_readout_noise = np.random.RandomState(seed + 1000)
    acting, latest, ratios = np.zeros(mirror.nValidAct), np.zeros(mirror.nValidAct), []
    for path in atmosphere(seed):
        setup.commands = acting, latest
        signal = measured(acting, path)
        residual = star.phase[pupil] * star.wavelength / IMAGING_M
        ratios.append(abs(np.exp(1j * residual).mean()) ** 2)
        acting, latest = latest, latest - gain * setup.control @ signal
    if attached is not None:
        with quiet:
            wfs.cam.photonNoise, wfs.cam.readoutNoise = False, 0
            attached.detach()
    return float(np.mean(ratios[SETTLE:]))


METHODS = {
    "OOPAO, weighted": [Setup(f"{w:g} px", threshold=0.0, fwhm_px=w) for w in (3.0, 4.0, 5.0)],
    "OOPAO, threshold": [Setup(f"{t:g} of the peak", threshold=t) for t in (0.05, 0.1, 0.2)],
    "faintspot, brightest pixels": [
        Setup(f"{k} pixels", estimator="brightest", keep_brightest=k) for k in (10, 15, 30)
    ],
    "faintspot, window": [
        Setup(f"{w:g} px", estimator="window", window_fwhm_px=w, flux_e=FLUX_E) for w in (3.0, 4.0, 5.0)
    ],
    "faintspot, smoothed": [
        Setup(f"{k} pixels", estimator="smoothed", keep_brightest=k) for k in (10, 15, 30)
    ],
    "faintspot, TV": [
        Setup(f"{s:g}, 15 pixels", estimator="tv", noise_std=s, keep_brightest=15) for s in (0.3, 0.6)
    ],
    "faintspot, map with prediction": [
        Setup(f"prior {p:g} px", estimator="map", prior_std_px=p, blur_px=0.8, flux_e=FLUX_E)
        for p in (0.3, 0.5, 0.8)
    ],
}


if __name__ == "__main__":
    print(f"{FLUX_E:g} e- a lenslet, {READ_NOISE_E:g} e- read noise; Strehl ratio at 1.65 um")
    compare(METHODS, strehl, GAINS, tuning=(1,))
