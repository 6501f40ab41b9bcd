"""Wavefronts from slopes: Zernike modes, their fit, figures and files."""

from __future__ import annotations

from typing import TYPE_CHECKING

from faintspot.base.lazy import lazy_attributes

if TYPE_CHECKING:
    from faintspot.wavefront.discrepancy import Discrepancy as Discrepancy
    from faintspot.wavefront.discrepancy import slope_discrepancy as slope_discrepancy
    from faintspot.wavefront.files import save_wavefront as save_wavefront
    from faintspot.wavefront.fit import Wavefront as Wavefront
    from faintspot.wavefront.fit import fit_wavefront as fit_wavefront
    from faintspot.wavefront.zernike import zernike as zernike

_HOMES = {
    "Discrepancy": "faintspot.wavefront.discrepancy",
    "Wavefront": "faintspot.wavefront.fit",
    "fit_wavefront": "faintspot.wavefront.fit",
    "save_wavefront": "faintspot.wavefront.files",
    "slope_discrepancy": "faintspot.wavefront.discrepancy",
    "zernike": "faintspot.wavefront.zernike",
}

__all__ = sorted(_HOMES)


__getattr__ = lazy_attributes(__name__, _HOMES)
