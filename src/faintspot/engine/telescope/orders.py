"""Conditions of a simulated telescope that can be changed while it runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from faintspot.base.checks import number_between, numbers_between
from faintspot.base.errors import InputError
from faintspot.base.toml_files import check_keys
from faintspot.loop.simulation.configuration.configuration import LoopConfiguration
from faintspot.loop.turbulence.slope_covariance import ARCSEC
from faintspot.slopes.spots.von_karman import R0_WAVELENGTH_M

ORDERS = ("photons", "magnitude", "r0_m", "seeing_arcsec", "wind_factor")
_FWHM = 0.976  # long-exposure FWHM in units of wavelength / r0, without outer scale (Roddier 1981)
_LARGEST_PHOTONS = 1e9


@dataclass(frozen=True)
class ObservingConditions:
    """The star's flux and the turbulence.

    Raises
    ------
    InputError
        When the flux exceeds what a camera can take.
    """

    photons: float
    """Photo-electrons per fully illuminated sub-aperture and frame."""
    r0_m: tuple[float, float]
    """Range within which the Fried parameter at 500 nm drifts."""
    wind_factor: float = 1.0
    """Wind speeds as a multiple of the configuration's."""

    def __post_init__(self) -> None:
        number_between("photons", self.photons, 0, _LARGEST_PHOTONS, low_open=True)

    @classmethod
    def of(cls, configuration: LoopConfiguration) -> ObservingConditions:
        """Return the configuration's own conditions."""
        r0 = configuration.atmosphere.r0_m
        return cls(configuration.photons, r0 if isinstance(r0, tuple) else (r0, r0))

    def ordered(self, configuration: LoopConfiguration, changes: Mapping[str, object]) -> ObservingConditions:
        """Return the conditions with changes, by the names of `ORDERS`.

        Raises
        ------
        InputError
            For an unknown name, a value out of its range, two values of the flux or two of the seeing.
        """
        check_keys("", changes, ORDERS, what="order")
        for pair in (("photons", "magnitude"), ("r0_m", "seeing_arcsec")):
            if all(name in changes for name in pair):
                raise InputError(f"{' and '.join(pair)}: expected one of the two, got both")
        new: dict[str, Any] = {}
        if "photons" in changes:
            new["photons"] = number_between("photons", changes["photons"], 0, _LARGEST_PHOTONS, low_open=True)
        if "magnitude" in changes:
            magnitude = number_between("magnitude", changes["magnitude"], -30, 60)
            new["photons"] = float(configuration.photometry.electrons(magnitude))
        if "r0_m" in changes:
            new["r0_m"] = _two_ends("r0_m", changes["r0_m"], 0.01, 1e3)
        if "seeing_arcsec" in changes:
            ends = _two_ends("seeing_arcsec", changes["seeing_arcsec"], 0.01, 10)
            new["r0_m"] = tuple(_FWHM * R0_WAVELENGTH_M / (ARCSEC * seeing) for seeing in ends)
        if "wind_factor" in changes:
            new["wind_factor"] = number_between("wind_factor", changes["wind_factor"], 0, 100)
        return replace(self, **new)


def _two_ends(name: str, value: object, low: float, high: float) -> tuple[float, float]:
    """Return a single number twice, or a pair unchanged."""
    ends = numbers_between(name, value, low, high)
    if ends.size not in (1, 2) or ends.ndim > 1:
        raise InputError(f"{name}: expected one number, or two to drift between, got {value!r:.80}")
    first, last = ends.flat[0], ends.flat[-1]
    return float(first), float(last)
