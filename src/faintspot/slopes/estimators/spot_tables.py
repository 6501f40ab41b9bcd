"""Tables of the estimators that know the spot, in the form that kernels read."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.statistics import FWHM_TO_STD
from faintspot.slopes.kernels.positions.brightest import SMALLEST_VARIANCE
from faintspot.slopes.kernels.positions.spot_rows import MARGIN, PHASES
from faintspot.slopes.spots.psf import PSF

START_SMOOTHING = (
    0.73  # standard deviation of the smoothing in units of the spot's FWHM: about a matched filter
)
_REACH = 2.5  # standard deviations at which a Gaussian is truncated
_START_OFFSETS = (-1.0 / 3.0, 0.0, 1.0 / 3.0)  # of the spot from the centre of its brightest pixel, px
_LEAST_START_FLUX = 1e-5  # fraction of a spot's flux, where hardly any pixel exceeds the image's mean
_OUTLIER_FRACTION = 0.01  # above which a slope is flagged
_NEAR_OUTLIERS = 0.9
_GRID_OF_FWHM = 0.25  # spacing of the posterior's grid, at most
_COARSEST_OF_FWHM = 0.4
_GRID_POSITIONS = 13  # approximate number of positions along an axis, otherwise
_BLOCK_NUMBERS = 1 << 22  # processed at a time, to limit the memory


@dataclass(frozen=True)
class SpotModel:
    """Profiles of the spots, or of weights centred on them, as the kernels read them."""

    tables: NDArray[np.float32]
    """(n_models, 2, rank, 2, PHASES, length), see `faintspot.slopes.kernels.positions.spot_rows.look_up`."""
    index: NDArray[np.int64]
    """Model of each sub-aperture."""
    fwhm_px: Floats
    """Full width at half maximum of the spots, (n_models, 2)."""
    taps: NDArray[np.float32]
    """Taps of the smoothing that finds the start, (n_models, 2, 1 + reach)."""
    start_flux: Floats
    """Fraction of its flux in the brightest pixel of a smoothed spot, (n_models,)."""
    gain: Floats
    """Factor on the steps of the weighted centre of gravity, (n_models, 2)."""

    @property
    def rank(self) -> int:
        """Number of separable terms."""
        return int(self.tables.shape[2])


def model_of_psf(psf: PSF, n: int, window: tuple[int, int], width: int, background: bool) -> SpotModel:
    """Prepare the PSFs of n sub-apertures; `background`: the mean of each image has been subtracted."""
    along, across = psf.separable_terms
    tables = [_profile_tables(terms, psf.oversampling, window, width) for terms in (along, across)]
    taps = gaussian_taps(START_SMOOTHING * psf.fwhm_px, window)
    flux = _start_flux(psf, taps, window, background=background)
    ones = np.ones((len(flux), 2))
    return SpotModel(np.stack(tables, axis=1), psf.index_of(n), psf.fwhm_px, taps, flux, ones)


def model_of_weights(
    weight_fwhm_px: Floats, spot_fwhm_px: Floats, psf: PSF | None, window: tuple[int, int], width: int
) -> SpotModel:
    """Prepare the Gaussian weights of each sub-aperture, with widths (n, 2) along x and y.

    The spots are taken to be Gaussian unless the PSF is known.
    """
    n = len(weight_fwhm_px)
    planes = np.zeros(n, np.int64) if psf is None else psf.index_of(n)
    kinds, index = np.unique(
        np.column_stack([weight_fwhm_px, spot_fwhm_px, planes]), axis=0, return_inverse=True
    )
    weights, fwhm, planes = kinds[:, :2], kinds[:, 2:4], kinds[:, 4].astype(np.int64)
    std = weights * FWHM_TO_STD
    tables = [_gaussian_tables(std[:, axis], window, width) for axis in range(2)]
    taps = gaussian_taps(START_SMOOTHING * fwhm, window)
    spots = psf
    if spots is None:
        spots, planes, gains = gaussian_psf(fwhm), np.arange(len(fwhm)), 1.0 + (fwhm / weights) ** 2
    else:
        gains = np.stack([_weighted_gain(spots, int(i), own) for i, own in zip(planes, std, strict=True)])
    flux = np.array([_start_flux(spots, taps[i : i + 1], window, int(k))[0] for i, k in enumerate(planes)])
    return SpotModel(np.stack(tables, axis=1), index.reshape(-1), fwhm, taps, flux, gains)


def gaussian_psf(fwhm_px: Floats) -> PSF:
    """Return Gaussian spots with widths (n, 2) along x and y."""
    longer, shorter = fwhm_px.max(axis=1), fwhm_px.min(axis=1)
    return PSF.analytic(
        "gaussian",
        size=shorter / 2.0,
        elongation=longer / shorter,
        angle_deg=np.where(fwhm_px[:, 0] < fwhm_px[:, 1], 90.0, 0.0),
        radius_px=10.0,
        index=np.arange(len(fwhm_px)),
    )


def gaussian_taps(std_px: Floats, window: tuple[int, int]) -> NDArray[np.float32]:
    """Return the taps (..., 1 + reach) of Gaussians of sum 1, the central tap first."""
    reach = max(1, min(math.ceil(_REACH * float(np.max(std_px))), max(window) - 1))
    exponent = -0.5 * (np.arange(reach + 1) / np.asarray(std_px)[..., None]) ** 2
    taps = np.exp(exponent)
    taps /= 2.0 * taps.sum(axis=-1, keepdims=True) - taps[..., :1]
    return taps.astype(np.float32)


def _places(window: tuple[int, int], width: int) -> tuple[int, Floats]:
    """Return the length of a profile's table, and the offsets (PHASES, length) of its elements [px]."""
    margin = max(window) + MARGIN
    length = 2 * margin + 2 * width
    return length, np.arange(length) - margin + np.arange(PHASES)[:, None] / PHASES


def _profile_tables(
    terms: Floats, oversampling: int, window: tuple[int, int], width: int
) -> NDArray[np.float32]:
    """Tabulate profiles (n, rank, nodes) and their derivatives: (n, rank, 2, PHASES, length)."""
    from scipy.interpolate import CubicSpline  # imported here: it takes longer than the first slopes

    _, offsets = _places(window, width)
    half = (terms.shape[2] - 1) / 2 / oversampling
    nodes = np.linspace(-half, half, terms.shape[2])
    spline = CubicSpline(nodes, terms, axis=2)
    inside = np.abs(offsets) <= half
    place = np.where(inside, offsets, 0.0)
    # An offset is pixel - position, so that the derivative with respect to the position changes sign.
    values = np.stack([spline(place), -spline(place, 1)], axis=2)
    return np.ascontiguousarray(np.where(inside, values, 0.0), np.float32)


def _gaussian_tables(std_px: Floats, window: tuple[int, int], width: int) -> NDArray[np.float32]:
    """Tabulate weights with maximum 1, as `_profile_tables`."""
    _, offsets = _places(window, width)
    z = offsets / std_px[:, None, None]
    weight = np.exp(-0.5 * z**2)
    values = np.stack([weight, weight * z / std_px[:, None, None]], axis=1)
    return np.ascontiguousarray(values[:, None], np.float32)


def _start_flux(
    psf: PSF,
    taps: NDArray[np.float32],
    window: tuple[int, int],
    plane: int | None = None,
    *,
    background: bool = False,
) -> Floats:
    """Return the mean brightest pixel of a smoothed spot over sub-pixel positions at the window centre."""
    offsets = np.array([(x, y) for x in _START_OFFSETS for y in _START_OFFSETS])
    ny, nx = window
    offsets += 0.5 * np.array([1 - nx % 2, 1 - ny % 2])  # from the pixel n // 2
    flux = np.empty(len(taps))
    for i, (along, across) in enumerate(taps.astype(np.float64)):
        images = psf.images(offsets, window, which=i if plane is None else plane)
        images -= images.mean(axis=(1, 2), keepdims=True) if background else 0.0
        x, y = (_taps_around(n // 2, values, n) for n, values in ((nx, along), (ny, across)))
        flux[i] = np.einsum("nyx,x,y->n", images, x, y).mean()
    return np.maximum(flux, _LEAST_START_FLUX)


def _taps_around(middle: int, taps: Floats, n: int) -> Floats:
    """Return the taps by which n pixels contribute to the smoothed value of the pixel `middle`."""
    away = np.abs(np.arange(n) - middle)
    return np.where(away < len(taps), taps[np.minimum(away, len(taps) - 1)], 0.0)


def _weighted_gain(psf: PSF, plane: int, std_px: Floats) -> Floats:
    """Return the inverse response of the weighted centre of gravity to a small displacement in x and y."""
    side = 2 * math.ceil(4.0 * float(std_px.max())) + 5
    u = np.arange(side) - (side - 1) / 2
    step, seen = 0.05, np.zeros(2)
    phases = (0.0, 0.25, 0.5, 0.75)
    for phase in phases:
        along, across = (np.exp(-0.5 * ((u - phase) / own) ** 2) for own in std_px)
        for axis in range(2):
            moved = np.full((2, 2), phase)
            moved[:, axis] += [-step, step]
            images = psf.images(moved, (side, side), which=plane) * along * across[:, None]
            profile = images.sum(axis=1 if axis == 0 else 2)
            centre = profile @ (u - phase) / profile.sum(axis=1)
            seen[axis] += (centre[1] - centre[0]) / (2 * step) / len(phases)
    return 1.0 / np.maximum(seen, 0.05)


def least_flux(
    psf: PSF, plane: int, variance: float, excess: float, search_range_px: float, side: int
) -> float:
    """Return the flux [electrons] below which noise causes about 1 % of a spot's positions.

    A spot is confused with one of the n places in the search range where noise can imitate one when the
    difference of two log-likelihood ratios, of variance twice its mean, has the wrong sign. The condition is
    n Q(t / sqrt(2)) = 0.01, where t is the significance in standard deviations and t^2 / 2 is the expected
    log-likelihood ratio of the spot against no spot. Add 0.9 to t, found by simulation, because errors beyond
    1 px also come from neighbouring places.
    """
    from scipy.optimize import brentq  # imported here: it takes longer than the first slopes
    from scipy.special import ndtri

    reach = min(search_range_px, 0.5 * side)
    places = max(1.0, (2.0 * reach / float(psf.fwhm_px[plane].mean())) ** 2)
    wanted = 0.5 * (math.sqrt(2.0) * -float(ndtri(_OUTLIER_FRACTION / places)) + _NEAR_OUTLIERS) ** 2
    offsets = np.array([(x, y) for x in _START_OFFSETS for y in _START_OFFSETS])
    image = np.maximum(psf.images(offsets, (side, side), which=plane), 0.0).mean(axis=0)
    if not image.any():
        return 0.0  # without noise
    v = max(variance, SMALLEST_VARIANCE)

    def missing(log_flux: float) -> float:
        m = math.exp(log_flux) * image
        ratio = ((m + v / excess) / excess * np.log1p(excess * m / v) - m / excess).sum()
        return math.log(max(ratio, 1e-300) / wanted)

    return math.exp(brentq(missing, math.log(1e-6), math.log(1e15), rtol=1e-4))


# Posterior on a grid --------------------------------------------------------------------------------


def posterior_grid(
    reach_px: float, fwhm_px: float, window: tuple[int, int]
) -> tuple[NDArray[np.float32], float]:
    """Return positions (n, 2) that cover +-reach_px around the window centre, and their spacing."""
    spacing = min(max(_GRID_OF_FWHM * fwhm_px, 2.0 * reach_px / _GRID_POSITIONS), _COARSEST_OF_FWHM * fwhm_px)
    axes = []
    for n in (window[1], window[0]):
        count = math.floor(min(reach_px, 0.5 * n) / spacing + 0.5)
        axes.append(spacing * np.arange(-count, count + 1))
    x, y = np.meshgrid(*axes)
    return np.column_stack([x.ravel(), y.ravel()]).astype(np.float32), spacing


def posterior_shape(positions: int, window: tuple[int, int], width: int) -> tuple[int, int, int]:
    """Return the shape of one table of the posterior: positions, rows, columns padded to whole vectors."""
    return positions, window[0], -(-window[1] // width) * width


def posterior_tables(
    psf: PSF,
    planes: NDArray[np.int64],
    flux_e: Floats,
    variance: Floats,
    excess: float,
    grid: NDArray[np.float32],
    window: tuple[int, int],
    width: int,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Compute log-likelihoods on a `posterior_grid` for triples of PSF, flux and variances of dark pixels.

    Those are (n, ny, nx), or (n, 1, 1) where they are the same in all pixels. Returns `logarithms` and
    `constants` of `PosteriorTables`.
    """
    nx = window[1]
    variance = np.maximum(variance, SMALLEST_VARIANCE)
    tables = np.zeros((len(flux_e), *posterior_shape(len(grid), window, width)), np.float32)
    constants = np.empty((len(flux_e), len(grid)), np.float32)
    block = max(1, _BLOCK_NUMBERS // (window[0] * nx))
    for start in range(0, len(grid), block):
        part, known = slice(start, start + block), None
        for i, (plane, flux, v) in enumerate(zip(planes, flux_e, variance, strict=True)):
            if known != (plane, flux):  # sub-apertures that differ in their noise alone follow each other
                known = plane, flux
                mean = np.maximum(psf.images(grid[part], window, flux, which=int(plane)), 0.0)
            logarithm = np.log1p(excess * mean / v)
            tables[i, part, :, :nx] = logarithm / excess
            constants[i, part] = (v / excess**2 * logarithm - mean / excess).sum(axis=(1, 2))
    return tables, constants
