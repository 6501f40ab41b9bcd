"""Units of wavefronts: pixels times sub-apertures, and lengths."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np

from faintspot.base.checks import number_between, one_of
from faintspot.base.errors import InputError
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.sensor.pupil import Pupil

UNITS = "nm", "um", "waves"
"""Units of length for wavefronts."""
POINTS = 201
"""Points of a map along the diameter of the pupil."""
_NM_PER_ARCSEC_M = 1e9 * np.pi / (180 * 3600)


@dataclass(frozen=True, kw_only=True)
class OfLength:
    """Base of fits whose values are lengths along the light's path."""

    unit: str
    """Unit: one of `UNITS`, or "px × sub-aperture" (slopes in pixels, lengths in sub-apertures)."""
    pupil: Pupil
    errors_from: str
    """Source of the standard errors: "frames" (the scatter over them), "slopes" (their standard errors) or
    "residuals" (the slopes' scatter about the fit, which counts as noise what is not fitted)."""
    left_out: str = ""
    """Line about the slopes that were left out; empty if there are none."""
    wavelength_nm: float | None = None
    """Length of a wave, for the unit "waves"."""

    _amounts: ClassVar[tuple[str, ...]] = ()
    """Names of the fields in the unit."""

    def in_unit(self, unit: str, wavelength_nm: float | None = None) -> Self:
        """Return the wavefront in another unit.

        Parameters
        ----------
        unit : {"nm", "um", "waves"}
        wavelength_nm : float, optional
            Required for waves, and only for them.

        Raises
        ------
        InputError
            If the wavefront is in pixels, or wavelength and unit do not fit.
        """
        one_of("unit", unit, UNITS)
        if (unit == "waves") != (wavelength_nm is not None):
            raise InputError("wavelength_nm: expected a wavelength for the unit waves, and for no other")
        if wavelength_nm is not None:
            wavelength_nm = number_between("wavelength_nm", wavelength_nm, 0, low_open=True)
        itself: Any = self  # a dataclass
        converted = replace(itself, unit=unit, wavelength_nm=wavelength_nm)
        factor = self.nm_per_unit / converted.nm_per_unit
        amounts = {name: getattr(self, name) for name in self._amounts}
        scaled = {name: factor * value for name, value in amounts.items() if value is not None}
        changed: Self = replace(converted, **scaled)
        return changed

    @property
    def nm_per_unit(self) -> float:
        """Length of the unit [nm].

        Raises
        ------
        InputError
            If the wavefront is in pixels.
        """
        lengths = {"nm": 1.0, "um": 1e3, "waves": self.wavelength_nm}
        length = lengths.get(self.unit)
        if length is None:
            raise InputError(
                "layout: expected pixel_scale_arcsec, and subaperture_m or diameter_m, for a wavefront in a "
                "unit of length"
            )
        return length


def unit_of(layout: Layout, pupil: Pupil) -> tuple[str, float]:
    """Return the unit of coefficients, and its value for one pixel times the disk's radius."""
    if layout.pixel_scale_arcsec is None or pupil.radius_m is None:
        return "px × sub-aperture", pupil.radius_subapertures
    return "nm", layout.pixel_scale_arcsec * pupil.radius_m * _NM_PER_ARCSEC_M
