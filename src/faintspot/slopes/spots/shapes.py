"""Noiseless spots of a lenslet, integrated over each pixel; von Karman model of the turbulence."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple, TypedDict

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.arrays import Floats
from faintspot.base.checks import check_shape, finite_array, numbers_between, one_of
from faintspot.base.errors import InputError
from faintspot.base.files import check_size

SMALLEST_SIZE = 0.05
"""Smallest spot size accepted, 0.1 px wide: narrower rotated spots need more samples."""

FWHM_OF_SIZE_1_PX = {"diffraction": 1.772, "gaussian": 2.0}
"""Full width at half maximum of the optical spot of size 1, by profile."""

_BLOCK_PIXELS = 1 << 15  # pixels processed at a time: the temporary arrays stay in the cache
_RIGHT_ANGLE_TOLERANCE_DEG = 1e-9


class SpotShape(TypedDict, total=False):
    """Options of `spots` that shape a spot."""

    profile: str
    size: ArrayLike
    elongation: ArrayLike
    angle_deg: ArrayLike


class _Profile(NamedTuple):
    """Profile of one axis of a spot of unit width and unit area."""

    width_px: float  # unit width of a spot of size 1
    cumulative: Callable[[Floats], Floats]
    density: Callable[[Floats], Floats]


class _Shapes(NamedTuple):
    """Position, flux, widths and angle of each spot, each of shape (n,)."""

    x: Floats
    y: Floats
    flux: Floats
    width_along: Floats
    width_across: Floats
    angle: Floats

    def take(self, index: slice | NDArray[np.generic]) -> _Shapes:
        return _Shapes(*(values[index] for values in self))


def _sinc_squared_cumulative(u: Floats) -> Floats:
    """Return the integral of sinc^2 from minus infinity to u: 1/2 + Si(2 pi u)/pi - u sinc^2(u), by parts."""
    from scipy.special import sici  # imported here, as below: it takes 0.1 s and is not needed for slopes

    integral: Floats = 0.5 + sici(2 * np.pi * u)[0] / np.pi - u * np.sinc(u) ** 2
    return integral


def _sinc_squared(u: Floats) -> Floats:
    # As np.sinc(u) ** 2, with half its passes over memory; sin(x) / x is 1 to round-off at 1e-30.
    angle = np.pi * u
    angle[angle == 0] = 1e-30
    sinc: Floats = np.sin(angle) / angle
    return np.square(sinc, out=sinc)


def _normal_cumulative(u: Floats) -> Floats:
    from scipy.special import ndtr

    integral: Floats = ndtr(u)
    return integral


def _normal(u: Floats) -> Floats:
    density: Floats = np.exp(-0.5 * u**2) / math.sqrt(2 * math.pi)
    return density


_PROFILES = {
    "diffraction": _Profile(2.0, _sinc_squared_cumulative, _sinc_squared),
    # Full width at half maximum 2 px = 2 sqrt(2 ln 2) standard deviations.
    "gaussian": _Profile(1 / math.sqrt(2 * math.log(2)), _normal_cumulative, _normal),
}


def spots(
    positions: ArrayLike,
    *,
    shape: tuple[int, int] = (16, 16),
    flux_e: ArrayLike = 1.0,
    profile: str = "diffraction",
    size: ArrayLike = 1.0,
    elongation: ArrayLike = 1.0,
    angle_deg: ArrayLike = 0.0,
) -> NDArray[np.float64]:
    """Return noiseless spot images: the mean number of electrons in each pixel.

    Spots whose axes are parallel to the pixel grid are integrated over the pixels in closed form. Others are
    integrated by Gauss-Legendre sampling of each pixel, with an error below 1e-4 of the brightest pixel
    (measured: 5e-5 at size 1, less at most others).

    Parameters
    ----------
    positions : array_like, shape (n, 2)
        x and y of the spot centres, in px from the centre of the image. Positions may lie outside the image.
    shape : (int, int)
        Rows and columns (ny, nx) of each image, px.
    flux_e : float or array_like, shape (n,)
        Electrons in the whole, infinite spot. Flux outside the image is lost, as with a field stop: a
        "diffraction" spot of size 1 at the centre of 16 x 16 px keeps 95 % of its flux. To set the flux
        inside the image instead, divide it by the sums of the images of unit flux.
    profile : {"diffraction", "gaussian"}
        "diffraction": the image behind a square lenslet of side d at wavelength lambda,
        sinc^2(x / w) sinc^2(y / w) with sinc(t) = sin(pi t) / (pi t) and w = lambda / d = 2 px * size;
        size 1 is Nyquist sampled. "gaussian": full width at half maximum 2 px * size.
    size : float or array_like, shape (n,)
        Width in units of 2 px, at least 0.05.
    elongation : float or array_like, shape (n,)
        Factor, at least 1, on the width along the x axis of the spot.
    angle_deg : float or array_like, shape (n,)
        Angle from the x axis of the image to that of the spot, towards y [degrees].

    Returns
    -------
    ndarray, float64, shape (n, ny, nx)
        Electrons per pixel, never negative.

    Raises
    ------
    InputError
        If a value is not finite or out of range, or an array has another shape.

    Examples
    --------
    >>> from faintspot.slopes.simulate import spots
    >>> print(spots([[0.0, 0.0]], shape=(4, 4), flux_e=100.0, profile="gaussian").round(1)[0])
    [[ 1.2  4.2  4.2  1.2]
     [ 4.2 14.5 14.5  4.2]
     [ 4.2 14.5 14.5  4.2]
     [ 1.2  4.2  4.2  1.2]]
    """
    kind = _PROFILES[one_of("profile", profile, list(_PROFILES))]
    shapes = _spot_shapes(positions, flux_e, size, elongation, angle_deg, kind)
    ny, nx = image_shape("shape", shape)
    quarter_turns = shapes.angle / 90
    aligned = np.abs(quarter_turns - np.rint(quarter_turns)) * 90 <= _RIGHT_ANGLE_TOLERANCE_DEG
    if profile == "gaussian":
        aligned |= shapes.width_along == shapes.width_across  # a round Gaussian looks the same at any angle
    smallest = float(np.min(shapes.width_across)) / kind.width_px
    images = np.empty((shapes.x.size, ny, nx))
    block = max(1, _BLOCK_PIXELS // (ny * nx))
    for start in range(0, shapes.x.size, block):
        part = shapes.take(slice(start, start + block))
        straight = aligned[start : start + block]
        target = images[start : start + block]
        if straight.any():
            target[straight] = _aligned_spots(part.take(straight), ny, nx, kind)
        if not straight.all():
            target[~straight] = _rotated_spots(part.take(~straight), ny, nx, kind, _samples(smallest))
    return images


def image_shape(name: str, shape: object) -> tuple[int, int]:
    """Return (rows, columns) as two integers of at least 1, or raise an InputError."""
    checked = numbers_between(name, shape, 1, 1 << 20, integer=True)
    if checked.shape != (2,):
        raise InputError(f"{name}: expected (rows, columns), got an array of shape {checked.shape}")
    check_size(name, checked.tolist(), what="pixels")
    return int(checked[0]), int(checked[1])


def position_array(positions: object) -> Floats:
    """Return positions as float64 of shape (n, 2), or raise an InputError."""
    checked = finite_array("positions", positions).astype(np.float64)
    check_shape("positions", checked, ("n", 2))
    return checked


def per_spot(name: str, value: object, n_spots: int, low: float = -np.inf) -> Floats:
    """Return one finite number >= `low` for each spot, shape (n_spots,), or raise an InputError."""
    checked = numbers_between(name, value, low)
    if checked.shape not in ((), (n_spots,)):
        raise InputError(f"{name}: expected one number or shape ({n_spots},), got {checked.shape}")
    return np.broadcast_to(checked, (n_spots,))


def _spot_shapes(
    positions: object, flux_e: object, size: object, elongation: object, angle_deg: object, kind: _Profile
) -> _Shapes:
    """Check the parameters of the spots and compute their widths."""
    checked = position_array(positions)
    n = len(checked)
    across = kind.width_px * per_spot("size", size, n, SMALLEST_SIZE)
    along = across * per_spot("elongation", elongation, n, 1.0)
    flux = per_spot("flux_e", flux_e, n, 0.0)
    return _Shapes(checked[:, 0], checked[:, 1], flux, along, across, per_spot("angle_deg", angle_deg, n))


def _pixel_centres(n: int) -> Floats:
    return np.arange(n, dtype=np.float64) - (n - 1) / 2


def _aligned_spots(spot: _Shapes, ny: int, nx: int, kind: _Profile) -> Floats:
    """Integrate spots whose axes are parallel to rows and columns: the product of two closed forms."""
    turned = np.rint(spot.angle / 90) % 2 == 1
    width_x = np.where(turned, spot.width_across, spot.width_along)
    width_y = np.where(turned, spot.width_along, spot.width_across)
    columns = _axis_fractions(spot.x, width_x, nx, kind) * spot.flux[:, None]
    rows = _axis_fractions(spot.y, width_y, ny, kind)
    return rows[:, :, None] * columns[:, None, :]


def _axis_fractions(centre: Floats, width: Floats, n: int, kind: _Profile) -> Floats:
    """Return the fraction of a one-dimensional spot in each of n pixels, shape (spots, n)."""
    edges = np.arange(n + 1) - n / 2
    cumulative = kind.cumulative((edges - centre[:, None]) / width[:, None])
    # Round-off in the far wings must not turn into negative flux.
    return np.maximum(np.diff(cumulative, axis=1), 0.0)


def _samples(smallest_size: float) -> int:
    """Return the Gauss-Legendre points per pixel and axis for an error below 1e-4 of the peak pixel."""
    return max(3, math.ceil(1 + 2 / smallest_size))


def _rotated_spots(spot: _Shapes, ny: int, nx: int, kind: _Profile, samples: int) -> Floats:
    """Integrate spots at any angle over the pixels with samples x samples Gauss-Legendre points in each."""
    nodes, weights = np.polynomial.legendre.leggauss(samples)
    angle = np.deg2rad(spot.angle)
    cosine, sine = np.cos(angle)[:, None], np.sin(angle)[:, None]
    along, across = spot.width_along[:, None], spot.width_across[:, None]
    total = np.zeros((spot.x.size, ny, nx))
    for node_y, weight_y in zip(nodes / 2, weights / 2, strict=True):
        dy = (_pixel_centres(ny) + node_y - spot.y[:, None])[:, :, None]
        for node_x, weight_x in zip(nodes / 2, weights / 2, strict=True):
            dx = (_pixel_centres(nx) + node_x - spot.x[:, None])[:, None, :]
            u = (cosine / along)[:, :, None] * dx + (sine / along)[:, :, None] * dy
            v = (cosine / across)[:, :, None] * dy - (sine / across)[:, :, None] * dx
            total += (weight_x * weight_y) * kind.density(u) * kind.density(v)
    scale: Floats = (spot.flux / (spot.width_along * spot.width_across))[:, None, None]
    return total * scale


R0_WAVELENGTH_M = 500e-9
"""Wavelength at which the Fried parameter r0 is given."""
SPECTRUM = 0.0229
"""Coefficient of the power spectral density of the phase, SPECTRUM r0^(-5/3) (f^2 + 1 / L0^2)^(-11/6)."""


def structure_function(separation: Floats, outer_scale: float) -> Floats:
    """Return the phase structure function [rad^2] for r0 = 1; infinite outer scale: Kolmogorov.

    D(r) = 6.88 r^(5/3) (Fried 1966, JOSA 56, 1372), or with an outer scale D(r) = 2 (B(0) - B(r)) with B(r)
    proportional to L0^(5/3) (2 pi r / L0)^(5/6) K_5/6(2 pi r / L0) (Conan 2008, JOSA A 25, 526).

    Parameters
    ----------
    separation : array
        Separation in units of r0.
    outer_scale : float
        L0 in units of r0.
    """
    from scipy.special import gamma, kv  # imported here: it takes 0.1 s and is not needed for slopes

    if math.isinf(outer_scale):
        kolmogorov: Floats = 6.88 * separation ** (5 / 3)
        return kolmogorov
    t = 2 * np.pi * np.maximum(separation, 1e-12) / outer_scale
    factor = gamma(11 / 6) / (2 ** (5 / 6) * np.pi ** (8 / 3)) * (24 / 5 * gamma(6 / 5)) ** (5 / 6)
    at_zero = 2 ** (-1 / 6) * gamma(5 / 6)
    von_karman: Floats = 2 * factor * outer_scale ** (5 / 3) * (at_zero - t ** (5 / 6) * kv(5 / 6, t))
    return von_karman
