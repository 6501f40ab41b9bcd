"""Table [laser] of a camera file: the elongated spots of a laser guide star."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from faintspot.base.checks import number_between, numbers_between
from faintspot.base.errors import InputError
from faintspot.base.toml_files import check_keys
from faintspot.sensor.layout import Layout
from faintspot.spots.laser import LaserGuideStar, gaussian_spot
from faintspot.spots.psf import PSF
from faintspot.spots.sodium import SodiumProfile

_FARTHEST_M = 1e3
_BEYOND_PX = 3.0  # of the window, to which PSFs reach


@dataclass(frozen=True, eq=False)
class LaserSpots:
    """Laser guide star, and the sub-aperture whose spots are simulated.

    Parameters
    ----------
    launch_m : (2,) array
        x and y of the launch telescope from the centre of the pupil [m].
    at_m : (2,) array
        x and y of the sub-aperture [m]; the farthest from the launch telescope has the longest spot.
    spot_fwhm_arcsec : float
        Full width at half maximum of the spot at a single altitude, with turbulence [arcsec].
    profile : SodiumProfile, optional
        Default: a Gaussian layer of 10 km at 90 km.
    zenith_distance_deg, site_altitude_m : float
        As for `faintspot.LaserGuideStar`.

    Raises
    ------
    InputError
        If a value is missing or out of range.
    """

    launch_m: Any
    at_m: Any
    spot_fwhm_arcsec: float
    profile: SodiumProfile = field(default_factory=SodiumProfile.gaussian)
    zenith_distance_deg: float = 0.0
    site_altitude_m: float = 0.0

    def __post_init__(self) -> None:
        for name in ("launch_m", "at_m"):
            place = numbers_between(f"laser.{name}", getattr(self, name), -_FARTHEST_M, _FARTHEST_M)
            if place.shape != (2,):
                raise InputError(f"laser.{name}: expected x and y, got shape {place.shape}")
            object.__setattr__(self, name, place)
        number_between("laser.spot_fwhm_arcsec", self.spot_fwhm_arcsec, 0.0, 60.0, low_open=True)

    @classmethod
    def from_table(cls, path: str | Path, table: dict[str, Any]) -> Self:
        """Read the table of a camera file; `profile` is the name of a file of `SodiumProfile.save` beside it.

        Raises
        ------
        InputError
            For an unknown key, or a value that is missing or out of range.
        """
        names = [item.name for item in fields(cls)]
        check_keys(f"{path}: laser.", table, names, required=names[:3])
        values = dict(table)
        if "profile" in values:
            if not isinstance(values["profile"], str):
                raise InputError(f"{path}: laser.profile: expected the name of a file")
            values["profile"] = SodiumProfile.load(Path(path).parent / values["profile"])
        return cls(**values)

    def star(self, places_m: ArrayLike, pixel_arcsec: float) -> LaserGuideStar:
        """Return the star as sub-apertures at these places see it."""
        spot = gaussian_spot(self.spot_fwhm_arcsec / pixel_arcsec)
        known = self.zenith_distance_deg, self.site_altitude_m
        return LaserGuideStar(places_m, self.launch_m, pixel_arcsec, spot, *known)

    def psf(self, places_m: ArrayLike, pixel_arcsec: float, window: tuple[int, int]) -> PSF:
        """Return the PSF of sub-apertures at places (n, 2) m, with the layer at the focus."""
        star = self.star(places_m, pixel_arcsec)
        profile = star.focused(self.profile)
        return star.psf(profile, radius_px=0.5 * max(window) + _BEYOND_PX)

    def in_words(self, pixel_arcsec: float, window: tuple[int, int]) -> str:
        """Describe the spot: its elongation, and the part of its flux that the window cuts off."""
        star = self.star([self.at_m], pixel_arcsec)
        profile = star.focused(self.profile)
        x, y = star.elongation_px(profile)[0]
        lost = 1.0 - float(star.images(profile, window).sum())
        place, angle = "{:g}, {:g} m".format(*self.at_m), math.degrees(math.atan2(y, x))
        return (
            f"laser guide star: spots of the sub-aperture at {place}, elongated by {math.hypot(x, y):.1f} px "
            f"along {angle:.0f} deg; the window cuts off {100 * max(lost, 0.0):.0f} % of their flux"
        )


def places_m(layout: Layout, subaperture_m: float) -> Any:
    """Return x and y of sub-apertures from the middle of the layout, (n, 2) m."""
    cells = layout.cells[:, ::-1].astype(np.float64)
    return (cells - 0.5 * (cells.min(axis=0) + cells.max(axis=0))) * subaperture_m
