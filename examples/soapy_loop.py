"""faintspot in a soapy closed loop: its slopes beside soapy's own, for a faint star.

A 3 m telescope, 5x5 lenslets of 12x12 pixels, 38 electrons per lenslet and frame, 250 frames/s, 1 electron of
read noise. One line between `aoinit` and `makeIMat` makes a sensor measure with faintspot. Every method has
an interaction matrix of its own and is tuned on other air than it is judged by.
"""

from __future__ import annotations

import contextlib
import io
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import soapy
from loop_table import compare

import faintspot as fs
from faintspot.adapters import soapy as adapter

FLUX_E, READ_NOISE_E, SETTLE = 38.0, 1.0, 30
GAINS = (0.2, 0.4, 0.6)
SYSTEM = f"""
simName:
pupilSize: 40
nGS: 1
nDM: 1
nSci: 1
nIters: 120
loopTime: 0.004
threads: 1
Atmosphere:
  {{scrnNo: 1, scrnHeights: [0], scrnStrengths: [1.0], windDirs: [30], windSpeeds: [10], r0: 0.15,
  wholeScrnSize: 256, infinite: false}}
Telescope: {{telDiam: 3.0, obsDiam: 0.0, mask: circle}}
WFS:
  0: {{type: ShackHartmann, GSMag: 12.18, GSPosition: [0, 0], GSHeight: 0, wavelength: 650.0e-9, nxSubaps: 5,
    pxlsPerSubap: 12, subapFOV: 1.8, subapThreshold: 0.5, photonNoise: true, eReadNoise: {READ_NOISE_E},
    propagationMode: Geometric, exposureTime: 0.004}}
DM:
  0: {{type: GaussStack, nxActuators: 6, svdConditioning: 0.05, gain: 0.5}}
Reconstructor: {{type: MVM, svdConditioning: 0.05, gain: 0.5, imatValue: 20}}
Science:
  0: {{type: PSF, wavelength: 1.65e-6, FOV: 1.0, pxls: 32, position: [0, 0]}}
"""


class Setup:
    """A way to measure slopes: soapy's own centroider, or faintspot's settings."""

    def __init__(self, label: str, own: str | None = None, threshold: float = 0.0, **ours: Any) -> None:
        self.label, self.own, self.threshold, self.ours = label, own, threshold, ours

    def __repr__(self) -> str:
        return self.label

    def use(self, wfs: Any) -> None:
        """Let a sensor measure so."""
        if self.own:
            wfs.config.centMethod, wfs.config.centThreshold = self.own, self.threshold
            wfs.getStatic()
            return
        camera, psf = fs.Calibration(dark=0.0, read_noise_e=READ_NOISE_E), fs.PSF.analytic(size=SPOT_PX / 2)
        adapter.attach(wfs, fs.Settings(**self.ours), camera, psf=psf)  # the one line


SPOT_PX = 0.65e-6 / 0.6 * 206265 / (1.8 / 12)  # lambda / d


def strehl(setup: Setup, gain: float, seed: int) -> float:
    """Close the loop and return the mean Strehl ratio at 1.65 um."""
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        path = Path(folder) / "system.yaml"
        path.write_text(SYSTEM)
        simulation = soapy.Sim(str(path))
        np.random.seed(seed)  # noqa: NPY002 - soapy draws its air and its noise from this one
        simulation.aoinit()
        setup.use(simulation.wfss[0])
        simulation.makeIMat(forceNew=True)
        simulation.config.recon.gain = gain
        for mirror in simulation.dms.values():
            mirror.dmConfig.gain = gain
        np.random.seed(seed + 1000)  # noqa: NPY002
        simulation.aoloop()
    return float(np.mean(simulation.instStrehl[0, SETTLE:]))


METHODS = {
    "soapy, brightest pixels": [
        Setup(f"{100 * f:g} %", own="brightest_pixel", threshold=f) for f in (0.1, 0.15)
    ],
    "soapy, threshold": [
        Setup(f"{f:g} of the peak", own="centre_of_gravity", threshold=f) for f in (0.2, 0.4)
    ],
    "faintspot, brightest pixels": [
        Setup(f"{k} pixels", estimator="brightest", keep_brightest=k) for k in (10, 15)
    ],
    "faintspot, window": [
        Setup(f"{w:g} px", estimator="window", window_fwhm_px=w, flux_e=FLUX_E) for w in (3.0, 5.0)
    ],
    "faintspot, smoothed": [Setup(f"{k} pixels", estimator="smoothed", keep_brightest=k) for k in (10, 15)],
    "faintspot, TV": [
        Setup(f"{s:g}, 15 pixels", estimator="tv", noise_std=s, keep_brightest=15) for s in (0.3, 0.6)
    ],
    "faintspot, map": [
        Setup(f"prior {p:g} px, blur {b:g} px", estimator="map", prior_std_px=p, blur_px=b, flux_e=FLUX_E)
        for p, b in ((0.5, 0.0), (0.5, 0.3), (1.0, 0.3))
    ],
}


if __name__ == "__main__":
    print(f"{FLUX_E:g} e- a lenslet, {READ_NOISE_E:g} e- read noise; Strehl ratio at 1.65 um")
    compare(METHODS, strehl, GAINS, tuning=(1, 2, 3))
