"""The slope pipeline in soapy (Reeves 2016, Proc. SPIE 9909, 99097F): as the centroider of a sensor."""

from __future__ import annotations

import sys
from typing import Any, Unpack

import numpy as np
from numpy.typing import NDArray

from faintspot.adapters.base import AdapterOptions, ToolSlopes
from faintspot.adapters.checks import check_version
from faintspot.adapters.spots import Spots
from faintspot.base.errors import InputError
from faintspot.camera.calibration import Calibration
from faintspot.pipeline.settings import Settings

TESTED = "0.15.0", "0.15.0"


def attach(
    wfs: Any,
    settings: Settings,
    calibration: Calibration | None = None,
    *,
    predict: Any = None,
    **options: Unpack[AdapterOptions],
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
        psf, score, calibration_flux_e, flux_frames, threads: see `faintspot.adapters.base.ToolSlopes`.

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
        options: AdapterOptions,
    ) -> None:
        centroiders = getattr(sys.modules.get(type(wfs).__module__), "centroiders", None)
        if centroiders is None or not hasattr(wfs, "centSubapArrays"):
            raise InputError(f"wfs: expected a ShackHartmann of soapy's, got {type(wfs).__name__}")
        check_version("soapy", "soapy", *TESTED)
        self.wfs, self._centroiders = wfs, centroiders
        self._n, side = int(wfs.n_subaps), int(wfs.nx_subap_pixels)
        self._first = 0.5 * (side - 1)
        self._spots = Spots("soapy", self._n, side, settings, calibration, predict, **options)
        self._former = wfs.config.centMethod
        # soapy finds its centroiders by name in the module that it takes them from.
        self._name = f"faintspot_{id(self)}"
        setattr(centroiders, self._name, self._centroid)
        wfs.config.centMethod = self._name
        try:
            wfs.getStatic()
        except InputError:
            self._put_back()
            raise

    def detach(self) -> None:
        """Put the former centroider back, and make the static slopes with it."""
        self._put_back()
        self.wfs.getStatic()

    def _put_back(self) -> None:
        self.wfs.config.centMethod = self._former
        delattr(self._centroiders, self._name)

    @property
    def measured(self) -> ToolSlopes:
        """What measures, with `last` slopes (px), `standard_errors` and `flux`."""
        return self._spots.measured

    def calibrating(self, flux_e: float | None = None) -> Any:
        """Measure as for calibration in a `with` block, see `ToolSlopes.calibrating`.

        soapy's frames of interaction matrices, and those of a sensor without noise, are measured so anyway.
        """
        return self.measured.calibrating(flux_e)

    def _centroid(self, images: Any, threshold: Any = None, ref: Any = None, **_: Any) -> NDArray[np.float64]:
        """Positions as soapy's centroiders give them: (2, n) px from the first pixel."""
        checked = self._spots.checked(images)
        config, static = self.wfs.config, self.wfs.staticData
        noise_free = bool(self.wfs.iMat) or not (config.photonNoise or config.eReadNoise)
        # soapy takes half a window off, so that a spot in the middle has -1/2, which is static, too.
        reference = np.full((2, self._n), 0.5)
        if static is not None:
            reference += static
        return self._spots.places(checked, reference, noise_free=noise_free) + self._first
