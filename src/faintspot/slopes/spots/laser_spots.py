"""Table [laser] of a configuration or camera file: the elongated spots of a laser guide star."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import numbers_between
from faintspot.base.errors import InputError, errors_within
from faintspot.base.options import FLAG, REQUIRED, number, setting
from faintspot.base.tables import ConfigurationTable
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.sensor.pupil import lenslet_pitch, pupil_of, side_m
from faintspot.slopes.spots.fixed_weights import FixedWeights
from faintspot.slopes.spots.laser import LaserGuideStar, gaussian_spot
from faintspot.slopes.spots.psf import PSF
from faintspot.slopes.spots.sodium import SodiumProfile

_FARTHEST_M = 1e3
_BEYOND_PX = 3.0  # of the window, to which PSFs reach


def _position(name: str, value: object) -> NDArray[np.float64]:
    position = numbers_between(name, value, -_FARTHEST_M, _FARTHEST_M)
    if position.shape != (2,):
        raise InputError(f"expected x and y, got shape {position.shape}", name=name)
    return position


@dataclass(frozen=True, eq=False)
class LaserSpots(ConfigurationTable, table="laser"):
    """Laser guide star of a sensor.

    Parameters
    ----------
    launch_m : (2,) array
        x and y of the launch telescope from the centre of the pupil [m].
    spot_fwhm_arcsec : float
        Full width at half maximum of the spot at a single altitude, with turbulence [arcsec].
    at_m : (2,) array, optional
        x and y of the sub-aperture whose spots `tune` simulates [m]; the farthest from the launch telescope
        has the longest spot.
    profile : SodiumProfile, optional
        Default: a Gaussian layer of 10 km at 90 km.
    zenith_distance_deg, site_altitude_m : float
        As for `faintspot.LaserGuideStar`.
    matched_filter : bool
        Whether weights of estimator "window" are the linear matched filter of these spots.

    Raises
    ------
    InputError
        If a value is missing or out of range.
    """

    launch_m: object = setting(REQUIRED, unit="m", check=_position)
    spot_fwhm_arcsec: float = number(REQUIRED, 0.0, 60.0, unit="arcsec", low_open=True)
    at_m: Any = setting(None, unit="m", check=_position)
    profile: SodiumProfile = field(default_factory=SodiumProfile.gaussian)
    zenith_distance_deg: float = 0.0
    site_altitude_m: float = 0.0
    matched_filter: bool = setting(False, kind=FLAG)

    @classmethod
    def from_table(cls, values: Mapping[str, object], path: Path | None = None) -> Self:
        """Read the table of a file; `profile` is the name of a file of `SodiumProfile.save` beside it.

        Raises
        ------
        InputError
            For an unknown key, or a value that is missing or out of range.
        """
        name = values.get("profile")
        if name is None:
            return super().from_table(values, path)
        path = path or Path()
        if not isinstance(name, str):
            raise InputError("expected the name of a file", name="laser.profile", where=f"{path}")
        with errors_within(path):
            profile = SodiumProfile.load(path.parent / name)
        return super().from_table({**values, "profile": profile}, path)

    def star(self, positions_m: ArrayLike, pixel_arcsec: float) -> LaserGuideStar:
        """Return the star as sub-apertures at these places see it."""
        spot = gaussian_spot(self.spot_fwhm_arcsec / pixel_arcsec)
        geometry = self.zenith_distance_deg, self.site_altitude_m
        return LaserGuideStar(positions_m, self.launch_m, pixel_arcsec, spot, *geometry)

    def star_of(self, layout: Layout) -> LaserGuideStar:
        """Return the star as the sub-apertures of a layout see it, around the middle of the pupil.

        Raises
        ------
        InputError
            If the layout does not know the angle of a pixel and the size of a sub-aperture.
        """
        side = side_m(layout.cells, layout.subaperture_m, layout.diameter_m)
        if layout.pixel_scale_arcsec is None or side is None:
            raise InputError(
                "layout: expected pixel_scale_arcsec, and subaperture_m or diameter_m, with a laser"
            )
        positions = (layout.centres - pupil_of(layout).centre_px) / lenslet_pitch(layout)
        return self.star(side * positions, layout.pixel_scale_arcsec)

    def psf(self, star: LaserGuideStar, window: tuple[int, int]) -> PSF:
        """Return the PSF of the star's sub-apertures, with the layer at the focus."""
        return psf_in_window(star, star.focused(self.profile), window)

    def in_words(self, pixel_arcsec: float, window: tuple[int, int]) -> str:
        """Describe the spot at `at_m`: its elongation, and the part of its flux that the window cuts off."""
        star = self.star([self.at_m], pixel_arcsec)
        profile = star.focused(self.profile)
        x, y = star.elongation_px(profile)[0]
        lost = 1.0 - float(star.images(profile, window).sum())
        at, angle = "{:g}, {:g} m".format(*self.at_m), math.degrees(math.atan2(y, x))
        return (
            f"laser guide star: spots of the sub-aperture at {at}, elongated by {math.hypot(x, y):.1f} px "
            f"along {angle:.0f} deg; the window cuts off {100 * max(lost, 0.0):.0f} % of their flux"
        )


def psf_in_window(star: LaserGuideStar, profile: SodiumProfile, window: tuple[int, int]) -> PSF:
    """Return the PSF of every sub-aperture for windows (ny, nx), as far as spots in them may be seen."""
    return star.psf(profile, radius_px=0.5 * max(window) + _BEYOND_PX)


def matched_filter(psf: PSF, layout: Layout, calibration: Calibration, flux_e: ArrayLike) -> FixedWeights:
    """Return the linear matched filter of a PSF for the noise of a camera.

    Parameters
    ----------
    psf : PSF
        That of every sub-aperture; of another number of PSFs the weights are for mean flux and noise.
    layout : Layout
    calibration : Calibration
    flux_e : float or (n,) array
        Flux of a spot [photo-electrons].

    Raises
    ------
    InputError
        If the read noise is not known, or as for `FixedWeights.matched`.
    """
    noise: Any = calibration.read_noise_photoelectrons
    if noise is None:
        raise InputError("laser.matched_filter: expected calibration.read_noise_e, got none")
    noise_map, per_window = calibration.read_noise_map(layout.frame_shape), len(psf.samples) == len(layout)
    if noise_map is not None and per_window:
        noise = np.nan_to_num(layout.images(noise_map), nan=noise)
    flux_e = flux_e if per_window else float(np.mean(np.asarray(flux_e, np.float64)))
    excess = calibration.excess_noise
    return FixedWeights.matched(psf, layout.window, flux_e=flux_e, read_noise_e=noise, excess_noise=excess)
