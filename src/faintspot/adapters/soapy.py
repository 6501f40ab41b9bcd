"""The slope pipeline in soapy (Reeves 2016, Proc. SPIE 9909, 99097F): as the centroider of a sensor."""

from __future__ import annotations

import sys
from typing import Any, Unpack

import numpy as np
from numpy.typing import NDArray

from faintspot.adapters.base import Options, ToolSlopes
from faintspot.adapters.checks import check_version, predicted
from faintspot.errors import InputError
from faintspot.sensor.calibration import Calibration
from faintspot.sensor.layout import Layout
from faintspot.settings import Settings

TESTED = "0.15.0", "0.15.0"


def attach(
    wfs: Any,
    settings: Settings,
    calibration: Calibration | None = None,
    *,
    predict: Any = None,
    **options: Unpack[Options],
) -> Attached:
    """Let a soapy `ShackHartmann` measure its slopes with faintspot, and make its static slopes anew.

    To be called after `sim.aoinit()` and before `sim.makeIMat(forceNew=True)`.

    Parameters
    ----------
    wfs : soapy.wfs.ShackHartmann
        As `sim.wfss[0]`.
    settings : Settings
    calibration : Calibration, optional
        Default: images are in electrons.
    predict : callable or object with `predict`, optional
        Takes the last slopes that the centroider gave, (2 n,) px after the static ones, and returns those
        that are expected next, for estimators that take a prior; called before each frame but the first.
    **options
        psf, score, calibration_light_e, light_frames, threads: see `faintspot.adapters.base.ToolSlopes`.

    Returns
    -------
    Attached
        `calibrating`, `measured`; `detach()` puts the former centroider back.

    Raises
    ------
    InputError
        For another sensor, or as for `ToolSlopes`.
    """
    return Attached(wfs, settings, calibration, predict, options)


class Attached:
    """faintspot in a sensor of soapy's; see `attach`."""

    def __init__(
        self,
        wfs: Any,
        settings: Settings,
        calibration: Calibration | None,
        predict: Any,
        options: Options,
    ) -> None:
        centroiders = getattr(sys.modules.get(type(wfs).__module__), "centroiders", None)
        if centroiders is None or not hasattr(wfs, "centSubapArrays"):
            raise InputError(f"wfs: expected a ShackHartmann of soapy's, got {type(wfs).__name__}")
        check_version("soapy", "soapy", *TESTED)
        self.wfs, self._predict, self._centroiders = wfs, predict, centroiders
        self._n, self._side = int(wfs.n_subaps), int(wfs.nx_subap_pixels)
        layout = Layout.stacked(self._n, (self._side, self._side))
        self.measured = ToolSlopes(layout, settings, calibration, **options)
        self._slopes: NDArray[np.float64] | None = None
        self._former = wfs.config.centMethod
        # soapy finds its centroiders by name in the module that it takes them from.
        self._name = f"faintspot_{id(self)}"
        setattr(centroiders, self._name, self._centroid)
        wfs.config.centMethod = self._name
        wfs.getStatic()

    def detach(self) -> None:
        """Put the former centroider back, and make the static slopes with it."""
        self.wfs.config.centMethod = self._former
        delattr(self._centroiders, self._name)
        self.wfs.getStatic()

    def calibrating(self, light_e: float | None = None) -> Any:
        """Measure as for calibration in a `with` block, see `ToolSlopes.calibrating`.

        soapy's frames of interaction matrices, and those of a sensor without noise, are measured so anyway.
        """
        return self.measured.calibrating(light_e)

    def _centroid(self, images: Any, threshold: Any = None, ref: Any = None, **_: Any) -> NDArray[np.float64]:
        """Positions as soapy's centroiders give them: (2, n) px from the first pixel."""
        shape = self._n, self._side, self._side
        if np.shape(images) != shape:
            raise InputError(f"soapy's images: expected shape {shape}, got {np.shape(images)}")
        config = self.wfs.config
        switched_off = bool(self.wfs.iMat) or not (config.photonNoise or config.eReadNoise)
        noise_free = switched_off or self.measured.noise_free
        static = self.wfs.staticData
        static = np.zeros((2, self._n)) if static is None else np.asarray(static, np.float64)
        # soapy takes half a window off, so that a spot in the middle has -1/2, which is static, too.
        first, half = 0.5 * (self._side - 1), 0.5 * self._side
        prior = None
        if not noise_free:
            slopes = predicted(self._predict, self._slopes, (2, self._n))
            prior = None if slopes is None else (slopes + static + half - first).ravel()
        frame = np.reshape(images, (-1, self._side))
        found = self.measured.measure(frame, prior_px=prior, noise_free=noise_free) + first
        found = np.where(self.measured.last.valid, found, static + half)
        if not noise_free:
            self._slopes = (found - half - static).ravel()
        return found
