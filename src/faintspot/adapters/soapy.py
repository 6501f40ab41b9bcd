"""The slope pipeline as the centroider of a soapy sensor (Reeves 2016, Proc. SPIE 9909, 99097F)."""

from __future__ import annotations

import sys
from typing import Any, Unpack

import numpy as np
from numpy.typing import NDArray

from faintspot.adapters.base import ToolSlopes
from faintspot.adapters.checks import check_version
from faintspot.adapters.spots import SpotOptions, Spots
from faintspot.base.errors import InputError
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.pipeline.settings import Settings

TESTED = "0.15.0"


def attach(
    wfs: object,
    settings: Settings,
    calibration: Calibration | None = None,
    **options: Unpack[SpotOptions],
) -> SoapyAttachment:
    """Make a soapy `ShackHartmann` measure its slopes with faintspot, and remake its static slopes.

    Call it after `sim.aoinit()` and before `sim.makeIMat(forceNew=True)`.

    Parameters
    ----------
    wfs : soapy.wfs.ShackHartmann
        Sensor, e.g. `sim.wfss[0]`.
    settings : Settings
    calibration : Calibration, optional
        Default: images are in electrons.
    predict : callable or object with `predict`, optional
        Takes the centroider's last slopes, (2 n,) px after subtraction of the static ones, and returns the
        prediction for the next frame, for estimators that use a prior; called before each frame except the
        first.
    **options
        psf, score, calibration_flux_e, flux_frames, threads: see `faintspot.adapters.base.ToolSlopes`.

    Returns
    -------
    SoapyAttachment
        `calibrating`, `measured`; `detach()` restores the former centroider.

    Raises
    ------
    InputError
        When the sensor is of another kind, or as for `ToolSlopes`.
    """
    return SoapyAttachment(wfs, settings, calibration, options)


class SoapyAttachment:
    """faintspot in a soapy sensor; see `attach`."""

    def __init__(
        self, wfs: Any, settings: Settings, calibration: Calibration | None, options: SpotOptions
    ) -> None:
        centroiders = getattr(sys.modules.get(type(wfs).__module__), "centroiders", None)
        if centroiders is None or not hasattr(wfs, "centSubapArrays"):
            raise InputError(f"wfs: expected soapy's ShackHartmann, got {type(wfs).__name__}")
        check_version("soapy", "soapy", TESTED)
        self.wfs, self._centroiders = wfs, centroiders
        self._n, side = int(wfs.n_subaps), int(wfs.nx_subap_pixels)
        self._first = 0.5 * (side - 1)
        self._spots = Spots("soapy", self._n, side, settings, calibration, **options)
        self._former = wfs.config.centMethod
        # soapy looks its centroiders up by name in their module.
        self._name = f"faintspot_{id(self)}"
        setattr(centroiders, self._name, self._centroid)
        wfs.config.centMethod = self._name
        try:
            wfs.getStatic()
        except InputError:
            self._put_back()
            raise

    def detach(self) -> None:
        """Restore the former centroider, and remake the static slopes with it."""
        self._put_back()
        self.wfs.getStatic()

    def _put_back(self) -> None:
        self.wfs.config.centMethod = self._former
        delattr(self._centroiders, self._name)

    @property
    def measured(self) -> ToolSlopes:
        """Measurement, with `last` slopes (px), `standard_errors` and `flux`."""
        return self._spots.measured

    def calibrating(self, flux_e: float | None = None) -> Any:
        """Measure as for calibration in a `with` block; see `ToolSlopes.calibrating`.

        soapy's frames for interaction matrices, and those of a noise-free sensor, are always measured this
        way.
        """
        return self.measured.calibrating(flux_e)

    def _centroid(self, images: Any, threshold: Any = None, ref: Any = None, **_: Any) -> NDArray[np.float64]:
        """Return positions as soapy's centroiders do: (2, n) px from the first pixel."""
        checked = self._spots.checked(images)
        config, static = self.wfs.config, self.wfs.staticData
        noise_free = bool(self.wfs.iMat) or not (config.photonNoise or config.eReadNoise)
        # soapy subtracts half a window, so that a centred spot has -1/2, which becomes part of the static
        # slopes.
        reference = np.full((2, self._n), 0.5)
        if static is not None:
            reference += static
        return self._spots.places(checked, reference, noise_free=noise_free) + self._first
