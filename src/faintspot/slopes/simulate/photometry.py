"""Stars: magnitudes, and the photo-electrons that they give in a sub-aperture and frame."""

import math
from dataclasses import dataclass, fields
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import finite_array, not_none, numbers_between
from faintspot.base.options import REQUIRED, Options, number, setting

# Flux density (Jy) at magnitude 0 and relative width of the band: Bessell 1979 (PASP 91, 589) for B to I,
# Campins, Rieke & Lebofsky 1985 (AJ 90, 896) for J to K.
_BANDS = {
    "B": (4260.0, 0.22),
    "V": (3640.0, 0.16),
    "R": (3080.0, 0.23),
    "I": (2550.0, 0.19),
    "J": (1600.0, 0.16),
    "H": (1080.0, 0.23),
    "K": (670.0, 0.23),
}
_PHOTONS_PER_JANSKY = 1.509e7  # photons / s / m^2 for a band of relative width 1: 1e-26 W/m^2/Hz over h

ZERO_POINTS = MappingProxyType(
    {band: float(f"{jansky * width * _PHOTONS_PER_JANSKY:.3g}") for band, (jansky, width) in _BANDS.items()}
)
"""Photons per second and m^2 of a star of magnitude 0 above the atmosphere, over the whole band."""

DEFAULT_BAND = "R"
DEFAULT_THROUGHPUT = 0.4  # atmosphere, telescope and the optics before the sensor
DEFAULT_QUANTUM_EFFICIENCY = 0.9


_part: dict[str, Any] = {"low": 0.0, "high": 1.0, "low_open": True}
_above_zero = partial(number, low=0.0, high=math.inf, low_open=True)


@dataclass(frozen=True, eq=False, kw_only=True)
class Passband(Options):
    """Photons of a star of magnitude 0, and their way to the detector.

    Parameters
    ----------
    band : str
        B, V, R, I, J, H or K; sets the zero point if that is not given.
    zero_point : float, optional
        Photons per second and m^2 of a star of magnitude 0 above the atmosphere, within the sensor's band.
    throughput : float
        Fraction of the photons that reaches the detector: atmosphere, telescope, optics. Default: 0.4.
    quantum_efficiency : float
        Fraction of these photons that is detected. Default: 0.9.

    Raises
    ------
    InputError
        If a value is out of range.
    """

    band: str = setting(DEFAULT_BAND, "Band of the magnitude.", choices=tuple(ZERO_POINTS), group="star")
    zero_point: float | None = _above_zero(
        None,
        meaning="Photons/s/m^2 of magnitude 0 in the band. Default: that of --band.",
        unit="photons",
        group="star",
    )
    throughput: float = setting(
        DEFAULT_THROUGHPUT, "Of atmosphere, telescope and optics.", group="star", **_part
    )
    quantum_efficiency: float = setting(
        DEFAULT_QUANTUM_EFFICIENCY, "Quantum efficiency.", group="star", **_part
    )


@dataclass(frozen=True)
class Photometry(Passband):
    """Electrons from a star in a sub-aperture and a frame.

    electrons = zero_point * 10^(-0.4 magnitude) * area_m2 * frame_time_s * throughput * quantum_efficiency.

    Parameters
    ----------
    area_m2 : float
        Area of a sub-aperture in the entrance pupil of the telescope.
    frame_time_s : float
        Exposure time of a frame.
    band, zero_point, throughput, quantum_efficiency
        See `Passband`.

    Raises
    ------
    InputError
        If a value is out of range.

    Examples
    --------
    >>> from faintspot.slopes.simulate import Photometry
    >>> photometry = Photometry(area_m2=0.36, frame_time_s=1 / 150, band="R")
    >>> round(float(photometry.electrons(11.0))), round(float(photometry.magnitude(100.0)), 1)
    (368, 12.4)
    """

    area_m2: float = _above_zero(REQUIRED)
    frame_time_s: float = _above_zero(REQUIRED)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.zero_point is None:
            object.__setattr__(self, "zero_point", ZERO_POINTS[self.band])

    @property
    def electrons_at_zero(self) -> float:
        """Electrons per sub-aperture and frame of a star of magnitude 0."""
        flux = not_none(self.zero_point) * self.area_m2 * self.frame_time_s
        return flux * self.throughput * self.quantum_efficiency

    def electrons(self, magnitude: ArrayLike) -> NDArray[np.float64]:
        """Return the electrons per sub-aperture and frame for stars of the given magnitudes.

        Raises
        ------
        InputError
            If magnitudes are not finite.
        """
        stars: NDArray[np.float64] = finite_array("magnitude", magnitude).astype(np.float64)
        return np.asarray(self.electrons_at_zero * 10 ** (-0.4 * stars))

    def magnitude(self, electrons: ArrayLike) -> NDArray[np.float64]:
        """Return the magnitudes of stars with the given electrons per sub-aperture and frame.

        Raises
        ------
        InputError
            If electrons are not above 0.
        """
        flux = numbers_between("electrons", electrons, 0.0, math.inf, low_open=True)
        return np.asarray(-2.5 * np.log10(flux / self.electrons_at_zero))


@dataclass(frozen=True, eq=False, kw_only=True)
class StarLight(Passband):
    """A star by its magnitude."""

    magnitude: float | None = number(
        None, -30.0, 60.0, "Magnitude; needs --subaperture-m and --frame-rate-hz.", unit="mag", group="star"
    )

    def photometry_of(self, subaperture_m: float, frame_rate_hz: float) -> Photometry:
        """Return the relation of magnitude and electrons for a sub-aperture and a frame."""
        light = {item.name: getattr(self, item.name) for item in fields(Passband)}
        return Photometry(subaperture_m**2, 1 / frame_rate_hz, **light)
