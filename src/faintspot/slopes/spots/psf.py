"""Super-sampled point-spread function (PSF) of a sensor's spots: analytic, given or learnt."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.arrays import Floats
from faintspot.base.checks import LARGEST_FLOAT32, check_shape, number_between, numbers_between
from faintspot.base.errors import InputError, drawn
from faintspot.base.files import NpzFile, check_size
from faintspot.slopes.spots.shapes import image_shape, per_spot, position_array, spots

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_ANALYTIC_OVERSAMPLING = 8
_LARGEST_RADIUS_PX = 128.0  # a window of the largest size needs 91 from corner to corner
_LONGEST_SIDE = 4097  # above it, the singular value decomposition takes minutes
_HIGHEST_RANK = 8
_RANK_TOLERANCE = 2e-3  # relative to the peak: largest error of the separable terms
_BLOCK_PIXELS = 1 << 21
_LARGEST_FRACTION = 1e6  # of a spot's flux in a pixel: above it, samples cancel each other


class Indexed(NpzFile):
    """Object of several kinds, one of which each sub-aperture has."""

    NAME: ClassVar[str]
    """Name in errors."""
    index: Any

    def _check_index(self, n_kinds: int) -> None:
        """Check the kind of each sub-aperture, if there are any, and make them read-only."""
        if self.index is None:
            return
        index = numbers_between(f"{self.NAME}.index", self.index, 0, n_kinds - 1, integer=True)
        check_shape(f"{self.NAME}.index", index, ("n_subapertures",))
        index.flags.writeable = False
        object.__setattr__(self, "index", index)

    def index_of(self, n_subapertures: int) -> NDArray[np.int64]:
        """Return the index of the kind of each sub-aperture.

        Raises
        ------
        InputError
            If the index is for another number of sub-apertures.
        """
        if self.index is None:
            return np.zeros(n_subapertures, np.int64)
        if len(self.index) != n_subapertures:
            raise InputError(
                f"{self.NAME}.index: expected {n_subapertures} numbers, one per sub-aperture, "
                f"got {len(self.index)}"
            )
        return self.index  # type: ignore[no-any-return]


@dataclass(frozen=True, eq=False)
class PSF(Indexed):
    """An effective, super-sampled point-spread function, for a whole sensor or for each sub-aperture.

    "Effective" means integrated over the pixel (Anderson & King 2000, PASP 112, 1360). The PSF is a cubic
    spline between its nodes and zero outside them.

    Parameters
    ----------
    samples : (n_psfs, rows, columns) or (rows, columns) array
        Fraction of a spot's flux in a pixel whose centre is at offset (dx, dy) px from the position of the
        spot. Node (r, c) is at dx = (c - (columns - 1) / 2) / oversampling and dy = (r - (rows - 1) / 2) /
        oversampling. The numbers of rows and columns are odd, at least 5. The sum must be positive; it is
        normalised so that the flux of all pixels together is 1 on average.
    oversampling : int
        Number of nodes per pixel.
    index : (n_subapertures,) array of int, optional
        PSF of each sub-aperture. Default: all have the first one. For as many PSFs as sub-apertures, use
        ``range(n)``.

    Raises
    ------
    InputError
        If samples are not finite, have the wrong shape or no flux, or an index is out of range.

    Examples
    --------
    >>> import faintspot as fs
    >>> psf = fs.PSF.analytic(size=1.0)
    >>> print(psf.fwhm_px.round(2))
    [[1.87 1.87]]
    """

    NAME, WHAT = "psf", "a PSF"
    FIELDS = ("samples", "oversampling", "index")

    samples: Any
    oversampling: int
    index: Any = None

    def __post_init__(self) -> None:
        oversampling = int(number_between("psf.oversampling", self.oversampling, 1, 64, integer=True))
        samples = numbers_between("psf.samples", self.samples, -LARGEST_FLOAT32, LARGEST_FLOAT32)
        samples = samples[None] if samples.ndim == 2 else samples
        sides = samples.shape[1:]
        if samples.ndim != 3 or min(sides) < 5 or any(side % 2 == 0 for side in sides):
            raise InputError(
                f"psf.samples: expected (n_psfs, rows, columns), both odd and at least 5, got {samples.shape}"
            )
        check_size("psf.samples", samples.shape)
        if max(sides) > _LONGEST_SIDE:
            raise InputError(
                f"psf.samples: expected at most {_LONGEST_SIDE} rows and columns, got {samples.shape}"
            )
        flux = samples.sum(axis=(1, 2), keepdims=True)
        if np.any(flux <= 0):
            raise InputError(f"psf.samples: expected a positive sum, got {flux.min():g}")
        samples = samples * (oversampling**2 / flux)
        if not np.abs(samples).max() <= _LARGEST_FRACTION:
            raise InputError(
                f"psf.samples: expected up to {_LARGEST_FRACTION:g} times a spot's flux in a pixel, "
                f"got {np.abs(samples).max():g}"
            )
        samples.flags.writeable = False
        for name, value in (("oversampling", oversampling), ("samples", samples)):
            object.__setattr__(self, name, value)
        self._check_index(len(samples))
        if self.index is None and len(samples) > 1:
            raise InputError(f"psf.index: expected the PSF of each sub-aperture, as there are {len(samples)}")

    def __repr__(self) -> str:
        """Return the number of PSFs and their size instead of all samples."""
        n, rows, columns = self.samples.shape
        size = f"{rows / self.oversampling:.3g} x {columns / self.oversampling:.3g} px"
        purpose = "" if self.index is None else f" for {len(self.index)} sub-apertures"
        return f"PSF({n} of {size}{purpose}, oversampling {self.oversampling})"

    def plot(self, axes: Axes | None = None, *, which: int = 0) -> Axes:
        """Draw a PSF: the fraction of the flux in a pixel, by its distance from the spot.

        Parameters
        ----------
        axes : matplotlib Axes, optional
            Default: new ones.
        which : int
            Index of the PSF.

        Returns
        -------
        Axes

        Raises
        ------
        InputError
            If there is no such PSF.
        MissingExtraError
            If matplotlib is not installed.
        """
        axes = drawn("slopes.spots.drawing:plot_psf", self, axes, which)
        return axes

    @classmethod
    def analytic(
        cls,
        profile: str = "diffraction",
        *,
        size: ArrayLike = 1.0,
        elongation: ArrayLike = 1.0,
        angle_deg: ArrayLike = 0.0,
        radius_px: float = 20.0,
        index: ArrayLike | None = None,
    ) -> PSF:
        """Return the PSF of `faintspot.slopes.spots.shapes`, out to `radius_px`.

        size, elongation and angle_deg are one number each, or one for each of several PSFs.
        """
        kinds = np.broadcast_arrays(*(np.atleast_1d(value) for value in (size, elongation, angle_deg)))
        radius = int(np.ceil(number_between("radius_px", radius_px, 1.0, _LARGEST_RADIUS_PX)))
        step = 1.0 / _ANALYTIC_OVERSAMPLING
        n = len(kinds[0])
        side = 2 * radius + 1
        nodes = (n, side * _ANALYTIC_OVERSAMPLING, side * _ANALYTIC_OVERSAMPLING)
        check_size("psf.samples", nodes, hint="give a smaller radius_px")
        samples = np.empty(nodes)
        # Spots displaced by fractions of a pixel sample the nodes in between.
        fractions = -step * np.arange(_ANALYTIC_OVERSAMPLING)
        size_of, elongation_of, angle_of = (np.repeat(kind, _ANALYTIC_OVERSAMPLING) for kind in kinds)
        for row in range(_ANALYTIC_OVERSAMPLING):
            images = spots(
                np.column_stack([np.tile(fractions, n), np.full(len(size_of), fractions[row])]),
                shape=(side, side),
                profile=profile,
                size=size_of,
                elongation=elongation_of,
                angle_deg=angle_of,
            )
            between = images.reshape(n, _ANALYTIC_OVERSAMPLING, side, side).transpose(0, 2, 3, 1)
            samples[:, row::_ANALYTIC_OVERSAMPLING] = between.reshape(n, side, -1)
        last = 1 - _ANALYTIC_OVERSAMPLING  # symmetric about the spot, with as many nodes on either side
        return cls(samples[:, :last, :last], _ANALYTIC_OVERSAMPLING, index)

    @cached_property
    def _spline(self) -> Floats:
        """Spline coefficients with a border of zeros, so that the PSF falls smoothly to zero."""
        from scipy.ndimage import spline_filter  # imported here, as below: it takes longer than first slopes

        return np.stack([spline_filter(np.pad(plane, 2), 3, mode="mirror") for plane in self.samples])

    def images(
        self,
        positions: ArrayLike,
        shape: tuple[int, int] = (16, 16),
        flux_e: ArrayLike = 1.0,
        *,
        which: ArrayLike = 0,
    ) -> Floats:
        """Return noiseless spot images, as `faintspot.slopes.spots.shapes` does.

        Parameters
        ----------
        positions : (n, 2) array
            x and y, px from the centre of the image.
        shape : (int, int)
        flux_e : float or (n,) array
            Flux of the whole spot [electrons].
        which : int or (n,) array of int
            Index of the PSF.

        Returns
        -------
        (n, ny, nx) array, float64

        Raises
        ------
        InputError
            If positions are not finite or of the wrong shape, or a PSF does not exist.
        """
        from scipy.ndimage import map_coordinates

        centres = position_array(positions)
        ny, nx = image_shape("shape", shape)
        n = len(centres)
        flux = per_spot("flux_e", flux_e, n)
        planes = np.broadcast_to(
            numbers_between("which", which, 0, len(self.samples) - 1, integer=True), (n,)
        )
        middle_y, middle_x = ((side - 1) / 2 for side in self._spline.shape[1:])
        images = np.empty((n, ny, nx))
        block = max(1, _BLOCK_PIXELS // (ny * nx))
        for plane in np.unique(planes):
            chosen = np.flatnonzero(planes == plane)
            for start in range(0, len(chosen), block):
                part = chosen[start : start + block]
                dx = np.arange(nx) - (nx - 1) / 2 - centres[part, 0, None]
                dy = np.arange(ny) - (ny - 1) / 2 - centres[part, 1, None]
                columns, rows = middle_x + self.oversampling * dx, middle_y + self.oversampling * dy
                nodes = np.broadcast_arrays(rows[:, :, None], columns[:, None, :])
                values = map_coordinates(
                    self._spline[plane], nodes, order=3, prefilter=False, mode="constant", cval=0.0
                )
                images[part] = flux[part, None, None] * values
        return images

    @cached_property
    def fwhm_px(self) -> Floats:
        """Full width at half maximum of the cuts through each PSF's peak along x and y, (n_psfs, 2) [px]."""
        widths = np.empty((len(self.samples), 2))
        for plane, width in zip(self.samples, widths, strict=True):
            row, column = np.unravel_index(np.argmax(plane), plane.shape)
            width[0] = _half_maximum_width(plane[row], int(column)) / self.oversampling
            width[1] = _half_maximum_width(plane[:, column], int(row)) / self.oversampling
        return widths

    def blurred(self, std_px: float) -> PSF:
        """Return the PSF convolved with a Gaussian of the given standard deviation [px].

        Raises
        ------
        InputError
            If the standard deviation is negative or NaN.
        """
        std = number_between("std_px", std_px, 0.0, 100.0) * self.oversampling
        from scipy.ndimage import gaussian_filter

        samples = gaussian_filter(self.samples, std, mode="constant", axes=(-2, -1))
        return PSF(samples, self.oversampling, self.index)

    @cached_property
    def separable_terms(self) -> tuple[Floats, Floats]:
        """Profiles along x (n_psfs, rank, columns) and y (n_psfs, rank, rows); their products add up to PSFs.

        The singular value decomposition is truncated at an error below 0.2 % of the peak (at most 8 terms).
        """
        u, s, vt = np.linalg.svd(self.samples, full_matrices=False)
        rank, peak = 1, self.samples.max(axis=(1, 2))
        remaining = self.samples - _outer(u, s, vt, 1)
        while rank < min(_HIGHEST_RANK, s.shape[1]) and np.any(
            np.abs(remaining).max(axis=(1, 2)) > _RANK_TOLERANCE * peak
        ):
            rank += 1
            remaining = self.samples - _outer(u, s, vt, rank)
        root = np.sqrt(s[:, :rank, None])
        return root * vt[:, :rank], root * np.swapaxes(u, 1, 2)[:, :rank]


@lru_cache(maxsize=16)
def spot_psf(size: float, elongation: float, profile: str = "diffraction", radius_px: float = 20.0) -> PSF:
    """Return `PSF.analytic` of one spot, which takes 20 ms: the same one again while it is remembered."""
    return PSF.analytic(profile, size=size, elongation=elongation, radius_px=radius_px)


def _outer(u: Floats, s: Floats, vt: Floats, rank: int) -> Floats:
    """Return the sum of the first terms of singular value decompositions."""
    product: Floats = (u[:, :, :rank] * s[:, None, :rank]) @ vt[:, :rank]
    return product


def _half_maximum_width(profile: Floats, peak: int) -> float:
    """Return the full width at half maximum of a sampled profile, interpolated linearly, in nodes."""
    half = 0.5 * profile[peak]
    width = 0.0
    for side in (profile[peak:], profile[peak::-1]):
        below = np.flatnonzero(side < half)
        if below.size == 0:
            width += len(side) - 1
        else:
            i = int(below[0])
            width += i - 1 + (side[i - 1] - half) / (side[i - 1] - side[i])
    return float(width)
