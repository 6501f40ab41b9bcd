"""Refraction of an eye from a wavefront: sphere, cylinder and axis in dioptres."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.slopes.wavefront.fit import Wavefront

Floats = NDArray[np.float64]

_SECOND_ORDER = 5  # modes: tilts, defocus and both astigmatisms


@dataclass(frozen=True)
class Refraction:
    """Lens that corrects the second order, in the convention of negative cylinders; arrays (...)."""

    sphere_d: Floats
    cylinder_d: Floats
    axis_deg: Floats
    """Axis of the cylinder from +x (columns) towards +y (rows), 0 to 180."""
    spherical_equivalent_d: Floats
    """Sphere plus half the cylinder."""

    @property
    def values(self) -> dict[str, Floats]:
        """Values by name."""
        return {item.name: getattr(self, item.name) for item in fields(self)}


def refraction(wavefront: Wavefront, coefficients: Floats) -> Refraction:
    """Return the refraction that corrects the second-order terms of wavefronts that leave an eye.

    With coefficients c of modes with mean square 1 on a pupil of radius r, the spherical equivalent is
    M = 4 sqrt(3) c4 / r^2, and the crossed cylinders are J0 = 2 sqrt(6) c6 / r^2, J45 = 2 sqrt(6) c5 / r^2.
    The cylinder is -2 sqrt(J0^2 + J45^2), the sphere M - cylinder / 2, the axis atan2(J45, J0) / 2 (Thibos,
    Hong, Bradley & Applegate 2004, J. Vision 4(4):9, 329). The signs are opposite to theirs, because a
    `Wavefront` increases along the displacement of spots: the light of a short-sighted eye converges, its
    defocus is negative, and so is the sphere.

    Parameters
    ----------
    wavefront : Wavefront
        In a unit of length, with at least 5 modes.
    coefficients : (..., k) array
        Coefficients in its unit, such as `wavefront.mean`.

    Raises
    ------
    InputError
        If the wavefront is in pixels or has fewer modes.
    """
    equivalent, j0, j45 = _power_vector(wavefront, coefficients)
    half = np.hypot(j0, j45)
    axis = np.rad2deg(np.arctan2(j45, j0)) / 2 % 180
    return Refraction(equivalent + half, -2 * half, axis, equivalent)


def refraction_error(wavefront: Wavefront) -> Refraction:
    """Return the standard errors of the mean wavefront's refraction, to first order, modes independent.

    Axis and cylinder mean little where the cylinder is not well above its error. Errors are those of
    `refraction`.
    """
    _, j0, j45 = _power_vector(wavefront, wavefront.mean)
    equivalent, error_0, error_45 = _power_vector(wavefront, wavefront.mean_standard_error)
    half = np.maximum(np.hypot(j0, j45), 1e-100)  # no division by 0
    of_half = np.hypot(j0 * error_0, j45 * error_45) / half
    axis = np.hypot(j45 * error_0, j0 * error_45) / half**2 / 2
    return Refraction(np.hypot(equivalent, of_half), 2 * of_half, np.rad2deg(axis), equivalent)


def _power_vector(wavefront: Wavefront, coefficients: Floats) -> tuple[Floats, Floats, Floats]:
    """Return M, J0 and J45 in dioptres."""
    if len(wavefront.modes) < _SECOND_ORDER:
        raise InputError(
            f"modes = {len(wavefront.modes)}: expected at least {_SECOND_ORDER}, the second order, for a "
            "refraction"
        )
    per_metre = 1e-9 * wavefront.nm_per_unit  # raises for pixels
    assert wavefront.pupil.radius_m is not None
    per_metre /= wavefront.pupil.radius_m**2
    defocus, oblique, straight = np.moveaxis(coefficients[..., 2:_SECOND_ORDER], -1, 0) * per_metre
    return 4 * np.sqrt(3) * defocus, 2 * np.sqrt(6) * straight, 2 * np.sqrt(6) * oblique
