"""Loops of OOPAO with its modulated pyramid, of which faintspot is told no geometry."""

import math
from pathlib import Path

import numpy as np

from benchmarks.loops.foreign.base import Control, Floats, SteppedLoop
from benchmarks.loops.foreign.oopao import POKE_M, OopaoCase, OopaoLoop, quiet

_MODULATION, _POINTS = 3.0, 12
"""Radius of the modulation in wavelengths over the diameter, and points on it."""
_PIXELS = 2
"""Pixels of a pupil image for each actuator spacing."""


class PyramidLoop(OopaoLoop):
    """Loop of OOPAO with a pyramid.

    Parameters
    ----------
    case : OopaoCase
        Its flux is that of the whole frame.
    folder : Path
    """

    is_modal = True

    def __init__(self, case: OopaoCase, folder: Path) -> None:
        from OOPAO.DeformableMirror import DeformableMirror
        from OOPAO.Pyramid import Pyramid
        from OOPAO.Source import Source
        from OOPAO.Telescope import Telescope

        SteppedLoop.__init__(self, folder, f"oopao-{case.diameter_m:g}")
        self._case, self.name, self.rate_hz = case, f"pyramid-{case.name}", case.rate_hz
        self.delay_frames, self.subaperture_m = case.delay_frames, case.diameter_m / case.lenslets
        self.r0_m, self.own, self.unit_arcsec = case.r0_m, {}, math.nan
        self.cells = np.zeros((0, 2), np.int64)
        with quiet():
            self._telescope = Telescope(
                resolution=case.lenslets * case.lenslet_px,
                diameter=case.diameter_m,
                samplingTime=1 / case.rate_hz,
                centralObstruction=0.25,
            )
            self._star = Source(optBand="R", magnitude=10)
            self._star * self._telescope
            self._wfs = Pyramid(
                nSubap=_PIXELS * case.lenslets,
                telescope=self._telescope,
                modulation=_MODULATION,
                nTheta_user_defined=_POINTS,
                lightRatio=0.5,
                postProcessing="slopesMaps",
            )
            self._mirror = DeformableMirror(self._telescope, nSubap=case.lenslets, mechCoupling=0.35)
            self._star**self._telescope * self._wfs
            self._star.nPhoton *= case.flux_e / self._wfs.cam.frame.sum()
            self._star**self._telescope * self._wfs
        self._pupil, self._factors = self._telescope.pupil.astype(bool), np.ones(self._mirror.nValidAct)
        self._wfs.cam.photonNoise, self._wfs.cam.readoutNoise = False, 0
        pokes = POKE_M * np.eye(self._mirror.nValidAct)
        self.interaction = np.array(
            [(self._measured(poke) - self._measured(-poke)) / (2 * POKE_M) for poke in pokes]
        ).T

    def true_gain(self, control: Control, seed: int, frames: int) -> float:
        """See `ForeignLoop`; it differs between modes."""
        return math.nan

    def _gradients(self) -> Floats:
        raise NotImplementedError
