"""Wavefronts from slopes: Zernike modes, figures and files."""

from __future__ import annotations

from typing import TYPE_CHECKING

from faintspot.base.errors import lazy_names

if TYPE_CHECKING:
    from faintspot.slopes.wavefront.certificate import Certificate as Certificate
    from faintspot.slopes.wavefront.certificate import Drift as Drift
    from faintspot.slopes.wavefront.certificate import certify as certify
    from faintspot.slopes.wavefront.certificate import fit_drift as fit_drift
    from faintspot.slopes.wavefront.discrepancy import Discrepancy as Discrepancy
    from faintspot.slopes.wavefront.discrepancy import slope_discrepancy as slope_discrepancy
    from faintspot.slopes.wavefront.files import save_wavefront as save_wavefront
    from faintspot.slopes.wavefront.fit import Wavefront as Wavefront
    from faintspot.slopes.wavefront.fit import fit_wavefront as fit_wavefront
    from faintspot.slopes.wavefront.zernike import zernike as zernike

__getattr__, __dir__, __all__ = lazy_names(__name__)
