"""Elongated spots of a laser guide star: the sodium profile seen from each sub-aperture."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from faintspot.base.arrays import Floats
from faintspot.base.checks import check_shape, number_between, numbers_between
from faintspot.base.errors import InputError
from faintspot.base.files import check_size
from faintspot.slopes.spots.psf import PSF
from faintspot.slopes.spots.shapes import image_shape, position_array
from faintspot.slopes.spots.sodium import SodiumProfile, integration_points

_OVERSAMPLING = 4  # nodes of a PSF per pixel
_SPOT_REACH = 2.5  # FWHM of the spot beyond the ends of the profile
_COARSEST_OF_FWHM = 0.5  # largest step along the elongation: the sum of Gaussians is then smooth to 1e-6
_LARGEST_RADIUS_PX = 48.0
_HIGHEST_SITE_M = 1e4
_LARGEST_ZENITH_DEG = 75.0
_ARCSEC = math.pi / 180 / 3600
_BLOCK_NUMBERS = 1 << 22
_FOCUS_STEPS = 4


@dataclass(frozen=True, eq=False)
class LaserGuideStar:
    """A laser guide star as a Shack-Hartmann sensor sees it, whose spots are elongated.

    The beam crosses the telescope's axis at the focus altitude. Light that returns from a distance d is then
    seen by a sub-aperture at p, with the launch telescope at L, at the offset (p - L) (1 / d_0 - 1 / d) from
    that of the focus, d_0 (from below the focus: towards the launch telescope). Positions are in the plane
    perpendicular to the line of sight, along the axes of the detector. An image is the sodium profile along
    this line, convolved with the spot. Fratricide, the pulse's length and the cone effect are left out.

    Parameters
    ----------
    subapertures_m : (n, 2) array
        x and y of the centres of the sub-apertures [m].
    launch_m : (2,) array
        x and y of the launch telescope [m]. Within a sub-aperture it is valid: that spot is round.
    pixel_arcsec : float
        Angle of a pixel [arcsec].
    spot : PSF
        Spot of a single altitude on the detector: uplink beam, turbulence, diffraction and pixels; one
        for all sub-apertures. ``PSF.analytic("gaussian", size=fwhm_px / 2)``, for example.
    zenith_distance_deg : float
        Angle of the line of sight from the zenith [degrees].
    site_altitude_m : float
        Altitude of the telescope above sea level [m].
    focus_altitude_m : float
        Altitude that the sensor is focused on [m]. A profile with another mean altitude is out of focus.
    range_gate_m : (2,) array, optional
        Lowest and highest altitude whose light is let through [m]. Default: all.

    Raises
    ------
    InputError
        If a value is out of range or of the wrong shape.

    Examples
    --------
    >>> import faintspot as fs
    >>> star = fs.LaserGuideStar(
    ...     [[0.0, 0.0], [4.0, 0.0]], [-4.0, 0.0], pixel_arcsec=0.5, spot=fs.PSF.analytic("gaussian")
    ... )
    >>> print(star.elongation_px(fs.SodiumProfile.gaussian(fwhm_m=10e3)).round(1))
    [[2.  0. ]
     [4.1 0. ]]
    """

    subapertures_m: Any
    launch_m: object
    pixel_arcsec: float
    spot: PSF
    zenith_distance_deg: float = 0.0
    site_altitude_m: float = 0.0
    focus_altitude_m: float = 90e3
    range_gate_m: Any = None

    def __post_init__(self) -> None:
        positions = numbers_between("star.subapertures_m", self.subapertures_m, -1e3, 1e3)
        check_shape("star.subapertures_m", positions, ("n", 2))
        launch = numbers_between("star.launch_m", self.launch_m, -1e3, 1e3)
        if launch.shape != (2,):
            raise InputError(f"star.launch_m: expected x and y, got shape {launch.shape}")
        number_between("star.pixel_arcsec", self.pixel_arcsec, 0.0, 100.0, low_open=True)
        number_between("star.zenith_distance_deg", self.zenith_distance_deg, 0.0, _LARGEST_ZENITH_DEG)
        site = number_between("star.site_altitude_m", self.site_altitude_m, -500.0, _HIGHEST_SITE_M)
        number_between("star.focus_altitude_m", self.focus_altitude_m, site + 1e3, 1e6)
        if not isinstance(self.spot, PSF) or len(self.spot.samples) != 1:
            raise InputError("star.spot: expected one PSF for all sub-apertures")
        for name, values in (("subapertures_m", positions), ("launch_m", launch)):
            values.flags.writeable = False
            object.__setattr__(self, name, values)
        if self.range_gate_m is not None:
            gate = numbers_between("star.range_gate_m", self.range_gate_m, 0.0)
            if gate.shape != (2,) or not gate[1] > gate[0]:
                raise InputError("star.range_gate_m: expected a lower and a higher altitude")

    def __len__(self) -> int:
        """Return the number of sub-apertures."""
        return len(self.subapertures_m)

    def inverse_distances(self, altitudes_m: ArrayLike) -> Floats:
        """Return 1 / distance [1/m] of altitudes along the line of sight.

        Raises
        ------
        InputError
            If an altitude is less than 1 km above the site.
        """
        heights = self._altitudes(altitudes_m) - self.site_altitude_m
        inverse: Floats = math.cos(math.radians(self.zenith_distance_deg)) / heights
        return inverse

    def offsets_px(self, altitudes_m: ArrayLike) -> Floats:
        """Return where altitudes (k,) are seen relative to the focus: (n, k, 2) px in x and y."""
        nearer = self.inverse_distances(self.focus_altitude_m) - self.inverse_distances(altitudes_m)
        baseline = self.subapertures_m - self.launch_m
        offsets: Floats = baseline[:, None, :] * nearer[:, None] / (self.pixel_arcsec * _ARCSEC)
        return offsets

    def defocus(self, altitudes_m: ArrayLike) -> Floats:
        """Return the defocus [1/m] due to a density of 1 per metre at each altitude (k,).

        The product with a profile's density is its mean inverse distance less that of the focus.
        """
        points, parts = integration_points(numbers_between("altitudes_m", altitudes_m, 0.0), _FOCUS_STEPS)
        away = self.inverse_distances(points) - self.inverse_distances(self.focus_altitude_m)
        defocus: Floats = away @ parts
        return defocus

    def elongation_px(self, profile: SodiumProfile) -> Floats:
        """Return the vector of each sub-aperture's elongation (n, 2) px, towards higher altitudes.

        Its length is the full width at half maximum of a Gaussian profile with the same standard deviation,
        without the spot: about baseline * FWHM * cos(zenith distance) / height^2.
        """
        std = profile.std_m
        ends = self.offsets_px(np.array([-0.5, 0.5]) * std + profile.mean_m)
        elongation: Floats = 2.0 * math.sqrt(2.0 * math.log(2.0)) * (ends[:, 1] - ends[:, 0])
        return elongation

    def focused(self, profile: SodiumProfile) -> SodiumProfile:
        """Return the profile moved in altitude so that the centre of gravity of every spot is at 0."""
        height = self.focus_altitude_m - self.site_altitude_m
        per_metre = float(self.inverse_distances(self.focus_altitude_m)) / height
        for _ in range(3):  # Newton's method; the first step leaves metres
            away = float(self.defocus(profile.altitudes_m) @ profile.density)
            profile = SodiumProfile(profile.altitudes_m + away / per_metre, profile.density)
        return profile

    def responses(
        self, altitudes_m: ArrayLike, shape: tuple[int, int] = (16, 16), positions: ArrayLike | None = None
    ) -> Floats:
        """Return images of a density of 1 per metre at each altitude, and 0 at all others.

        Images are linear in the profile: those of a profile are the product of this array and its density.

        Parameters
        ----------
        altitudes_m : (k,) array
            Altitudes of a profile [m].
        shape : (int, int)
            Rows and columns of the windows, which truncate the images.
        positions : (n, 2) array, optional
            Slopes of the spots: x and y of the focus, px from the window centre. Default: 0.

        Returns
        -------
        (n, ny, nx, k) array
            Fraction of the flux in each pixel.

        Raises
        ------
        InputError
            If a value is out of range, or positions have another shape.
        """
        rows, columns, positions_px = self._pixels(shape, positions)
        altitudes = self._altitudes(altitudes_m)
        check_size("responses", (len(self), len(rows), len(columns), len(altitudes)))
        points, parts = self._points(altitudes)
        offsets = self.offsets_px(points)
        images = np.empty((len(self), len(rows), len(columns), len(altitudes)))
        for block in self._blocks(len(points) * len(rows) * len(columns)):
            along, across = _profiles(self.spot, positions_px[block, None] + offsets[block], columns, rows)
            points_images = np.einsum("rskx,rsky->sxyk", along, across, optimize=True)
            images[block] = (points_images @ parts).swapaxes(1, 2)
        return images

    def images(
        self, profile: SodiumProfile, shape: tuple[int, int] = (16, 16), positions: ArrayLike | None = None
    ) -> Floats:
        """Return the mean image of each sub-aperture for a flux of 1: (n, ny, nx), as `responses`."""
        rows, columns, where = self._pixels(shape, positions)
        points, parts = self._points(self._altitudes(profile.altitudes_m))
        return self._along_lines(self.offsets_px(points), parts @ profile.density, where, columns, rows)

    def psf(
        self, profile: SodiumProfile, *, radius_px: float | None = None, oversampling: int = _OVERSAMPLING
    ) -> PSF:
        """Return the PSF of every sub-aperture, for `SlopePipeline`, `simulate` and bounds.

        Parameters
        ----------
        profile : SodiumProfile
        radius_px : float, optional
            Half the side of the PSF. Default: as far as the longest spot reaches, at most 48.
        oversampling : int
            Nodes per pixel.

        Raises
        ------
        InputError
            If a value is out of range, or no light comes through the range gate.
        """
        points, parts = self._points(profile.altitudes_m)
        offsets, flux = self.offsets_px(points), parts @ profile.density
        if radius_px is None:
            reach = np.abs(offsets[:, flux > 1e-3 * flux.max()]).max(initial=0.0)
            radius_px = min(float(reach + _SPOT_REACH * self.spot.fwhm_px.max()), _LARGEST_RADIUS_PX)
        half = math.ceil(oversampling * number_between("radius_px", radius_px, 1.0, 2 * _LARGEST_RADIUS_PX))
        nodes = np.arange(-half, half + 1) / oversampling
        check_size("psf.samples", (len(self), len(nodes), len(nodes)), hint="give a smaller radius_px")
        samples = self._along_lines(offsets, flux, np.zeros((len(self), 2)), nodes, nodes)
        return PSF(samples, oversampling, range(len(self)))

    def _along_lines(
        self, offsets: Floats, flux: Floats, where: Floats, columns: Floats, rows: Floats
    ) -> Floats:
        """Return the sum of spots with a flux (k,) at offsets (n, k, 2) from `where` (n, 2)."""
        images = np.empty((len(self), len(rows), len(columns)))
        for block in self._blocks(len(flux) * max(len(rows), len(columns))):
            along, across = _profiles(self.spot, where[block, None] + offsets[block], columns, rows)
            images[block] = (across.swapaxes(2, 3) @ (flux[:, None] * along)).sum(axis=0)
        return images

    def _pixels(self, shape: object, positions: object) -> tuple[Floats, Floats, Floats]:
        """Return the places of rows and columns [px], and checked positions (n, 2)."""
        sides = image_shape("shape", shape)
        where = np.zeros((len(self), 2)) if positions is None else position_array(positions)
        check_shape("positions", where, self.subapertures_m.shape)
        rows, columns = (np.arange(side, dtype=np.float64) - 0.5 * (side - 1) for side in sides)
        return rows, columns, where

    def _altitudes(self, altitudes_m: ArrayLike) -> Floats:
        """Return altitudes that are surely above the site."""
        return numbers_between("altitudes_m", altitudes_m, self.site_altitude_m + 1e3, 1e6)

    def _points(self, altitudes_m: Floats) -> tuple[Floats, Floats]:
        """Return `integration_points` so fine that no gaps show between the spots, within the gate."""
        steps = np.abs(np.diff(self.offsets_px(altitudes_m), axis=1)).max(initial=0.0)
        coarsest = _COARSEST_OF_FWHM * float(self.spot.fwhm_px.min())
        points, parts = integration_points(altitudes_m, max(2, math.ceil(steps / coarsest)))
        low, high = (0.0, np.inf) if self.range_gate_m is None else self.range_gate_m
        let_through = (points >= low) & (points <= high)
        return points, parts * let_through[:, None]

    def _blocks(self, numbers: int) -> list[slice]:
        """Return parts of the sub-apertures with a limited number of intermediate values each."""
        size = max(1, _BLOCK_NUMBERS // max(numbers, 1))
        return [slice(start, start + size) for start in range(0, len(self), size)]


def gaussian_spot(fwhm_px: float) -> PSF:
    """Return the round Gaussian spot of a width [px] that the light of a single altitude makes."""
    size = fwhm_px / 2
    return PSF.analytic("gaussian", size=size, radius_px=max(4.0, 6.0 * size))


def _profiles(spot: PSF, centres: Floats, columns: Floats, rows: Floats) -> tuple[Floats, Floats]:
    """Return the separable terms of spots at centres (n, k, 2): (rank, n, k, columns or rows)."""
    from scipy.interpolate import CubicSpline  # imported here: it takes longer than the first slopes

    profiles = []
    for terms, pixels, axis in zip(spot.separable_terms, (columns, rows), (0, 1), strict=True):
        half = (terms.shape[2] - 1) / 2 / spot.oversampling
        spline = CubicSpline(np.linspace(-half, half, terms.shape[2]), terms[0], axis=1)
        distance = pixels - centres[..., axis, None]
        profiles.append(np.where(np.abs(distance) <= half, spline(np.clip(distance, -half, half)), 0.0))
    return profiles[0], profiles[1]
