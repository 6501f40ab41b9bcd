"""Centroid gain of spots that move, and their displacements where each is too faint to measure."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike

from faintspot.base.arrays import Floats
from faintspot.base.checks import check_shape, finite_array
from faintspot.base.errors import InputError
from faintspot.slopes.pipeline.slopes import Slopes
from faintspot.slopes.spots.psf import PSF

_BLOCKS = 20  # of frames, whose scatter says the error: noise and turbulence are correlated for shorter
_FEWEST_FRAMES = 2 * _BLOCKS

_BEYOND = 0.01  # share of the spots that may be farther out
_SMALLEST_STEP_PX, _STEPS_PER_SIDE = 0.25, 64
_FLUX_CLASS = 1.25  # ratio of the fluxes of sub-apertures that share a table
_FAINTEST = 0.05  # of the mean flux
_WEIGHT_FLOOR = 1e-3  # of the flux, in electrons squared: faint wings are not known exactly
_ITERATIONS = 200
_SCALES = (0.02, 1.5)  # of the fitted flux, within which the flux is sought
_IMAGES_FOR_SCALE = 512
_DECISIVE_NATS = 3.0  # log likelihood by which another range must be worse
_ELSEWHERE = 0.1  # share of the spots that the other hypothesis has anywhere in the window
_NEARLY_ALL = 0.8  # of half a window: a larger range is not distinguished from the whole window


@dataclass(frozen=True)
class CentroidGain:
    """Slope per pixel of displacement, along x and y."""

    gain: Floats
    """(n, 2)"""
    standard_error: Floats
    """(n, 2)"""

    @property
    def mean(self) -> tuple[float, float]:
        """Mean over sub-apertures and axes, each counting by its error, and its standard error."""
        usable = np.isfinite(self.standard_error) & (self.standard_error > 0)
        if not usable.any():
            return float(self.gain.mean()), 0.0
        weight = self.standard_error[usable] ** -2.0
        return float((weight * self.gain[usable]).sum() / weight.sum()), float(weight.sum() ** -0.5)


def measure_centroid_gain(slopes: Slopes | ArrayLike, displacement_px: ArrayLike) -> CentroidGain:
    """Return the centroid gain of every sub-aperture from frames in which the spots were moved.

    The regression of slopes on displacements that are known: a dither of tip and tilt, or what recorded
    commands move the spots by (the interaction matrix at a gain of 1 times the commands). What moves the
    spots beside that, and noise, must not follow the same course: dither at a frequency of its own. Quad
    cells, whose gain follows the size of the spot, are calibrated so.

    Parameters
    ----------
    slopes : Slopes of several frames, or (n_frames, 2 n) array
        All x, then all y, px.
    displacement_px : (n_frames, 2) or (n_frames, 2 n) array
        Of all spots along x and y, or of each, px.

    Returns
    -------
    CentroidGain
        Its errors are from the scatter of the result among 20 stretches of frames.

    Raises
    ------
    InputError
        For fewer than 40 frames, arrays that do not fit together, or spots that were not moved.

    Examples
    --------
    >>> import numpy as np
    >>> from faintspot.slopes.training import measure_centroid_gain
    >>> dither = 0.1 * np.sin(2 * np.pi * 0.13 * np.arange(400))[:, None] * [1.0, 1.0]
    >>> noise = np.random.default_rng(1).normal(0.0, 0.02, (400, 6))
    >>> slopes = 0.7 * np.repeat(dither, 3, axis=1) + noise
    >>> print(measure_centroid_gain(slopes, dither).gain.round(1))
    [[0.7 0.7]
     [0.7 0.7]
     [0.7 0.7]]
    """
    measured = finite_array("slopes", slopes.vector if isinstance(slopes, Slopes) else slopes)
    moved = finite_array("displacement_px", displacement_px).astype(np.float64)
    if measured.ndim != 2 or measured.shape[1] % 2 or len(measured) < _FEWEST_FRAMES:
        raise InputError(
            f"slopes: expected (n_frames, 2 n) with at least {_FEWEST_FRAMES} frames, got {measured.shape}"
        )
    n = measured.shape[1] // 2
    if moved.shape == (len(measured), 2):
        moved = np.repeat(moved, n, axis=1)
    check_shape("displacement_px", moved, (len(measured), 2), measured.shape)
    moved = moved - moved.mean(axis=0)
    square = (moved**2).sum(axis=0)
    if np.any(square <= 0):
        raise InputError("displacement_px: expected all spots to move along x and y, some stand still")
    slopes_about_mean = measured - measured.mean(axis=0)
    gain = (slopes_about_mean * moved).sum(axis=0) / square
    residual = (slopes_about_mean - gain * moved) * moved
    parts = np.stack([part.sum(axis=0) for part in np.array_split(residual, _BLOCKS)])
    error = parts.std(axis=0, ddof=1) * math.sqrt(_BLOCKS) / square
    return CentroidGain(gain.reshape(2, n).T, error.reshape(2, n).T)


@dataclass(frozen=True)
class SpotRange:
    """Distance of spots from their references, and their flux.

    Examples
    --------
    >>> from faintspot.slopes.training.centroid_gain import SpotRange
    >>> SpotRange(quantile_px=1.2, flux_scale=0.9, is_measured=True).is_measured
    True
    """

    quantile_px: float
    """99 % of the spots are nearer than this, on each axis."""
    flux_scale: float
    """Flux of the spots over that of the fit: below 1 where fits take noise for spots."""
    is_measured: bool
    """Whether the flux is enough to tell the range."""


class Images(NamedTuple):
    """Images of single spots, and what is known of them."""

    pixels_e: Floats
    """(n, ny, nx) photo-electrons, without background."""
    references: Floats
    """(n, 2) reference positions, px."""
    flux_e: Floats
    """(n,) flux of the sub-aperture of each, up to a common factor."""
    dark_variance_e2: float
    excess_noise: float

    def some(self, count: int) -> Images:
        """Return at most so many of them, evenly spread."""
        index = np.linspace(0, len(self.pixels_e) - 1, min(count, len(self.pixels_e))).astype(int)
        return self._replace(
            pixels_e=self.pixels_e[index], references=self.references[index], flux_e=self.flux_e[index]
        )


def spot_range(images: Images, psf: PSF) -> SpotRange:
    """Estimate how far spots are from their references, whatever noise does to single positions.

    Positions are never measured one by one. The likelihood of every image is averaged over centred squares of
    all sizes; the mixture of squares that makes all images together most likely is the distribution of the
    spots. An image whose brightest peak is noise is about as likely wherever the spot is, and does not count.

    Parameters
    ----------
    images : Images
    psf : PSF
        The first is that of all spots.

    Returns
    -------
    SpotRange

    Notes
    -----
    Maximum likelihood of a mixing distribution: Laird 1978, JASA 73, 805.
    """
    squares = _Squares.of(images.pixels_e.shape[1:], psf)
    few = images.some(_IMAGES_FOR_SCALE)
    bounds = (math.log(_SCALES[0]), math.log(_SCALES[1]))
    best = scipy.optimize.minimize_scalar(
        lambda log_scale: -_mixed(*squares.evidence(few, math.exp(log_scale))).log_likelihood,
        bounds=bounds,
        method="bounded",
        options={"xatol": 0.05, "maxiter": 10},
    )
    scale = math.exp(float(best.x))
    evidence, offset = squares.evidence(images, scale)
    mixed = _mixed(evidence, offset)
    distances = np.linspace(0.0, squares.radii_px[-1], 1024)
    within = np.minimum(distances[:, None] / squares.radii_px, 1.0) @ mixed.weights
    quantile = float(distances[np.argmax(within >= 1 - _BEYOND)])
    return SpotRange(quantile, scale, _is_measured(evidence, mixed, quantile, squares.radii_px))


class _Mixed(NamedTuple):
    """The most likely mixture of squares."""

    weights: Floats
    log_likelihood: float


def _mixed(evidence: Floats, offset: float) -> _Mixed:
    """Find the mixture by expectation maximisation."""
    weights = np.full(evidence.shape[1], 1 / evidence.shape[1])
    for _ in range(_ITERATIONS):
        weights = weights * np.mean(evidence / (evidence @ weights)[:, None], axis=0)
    return _Mixed(weights, float(np.log(evidence @ weights).sum()) + offset)


def _is_measured(evidence: Floats, mixed: _Mixed, quantile: float, radii: Floats) -> bool:
    """Tell whether the images exclude spots anywhere in the window, and spots within half the range."""
    best = evidence @ mixed.weights
    evidence_needed = min(_DECISIVE_NATS, -0.5 * len(best) * math.log1p(-_ELSEWHERE))
    wider = (1 - _ELSEWHERE) * best + _ELSEWHERE * evidence[:, -1]
    if quantile < _NEARLY_ALL * radii[-1] and np.log(best / wider).sum() < evidence_needed:
        return False
    nearer = np.where(radii <= quantile / 2, evidence, 0.0).max(axis=1)
    with np.errstate(divide="ignore"):
        return bool(quantile <= 1.0 or np.log(best / nearer).sum() >= evidence_needed)


@dataclass(frozen=True)
class _Squares:
    """Spots on a grid of positions, and the centred squares that these fill."""

    spots: Floats
    """(m, pixels) of 1 e-."""
    positions: Floats
    """(m, 2), px."""
    step_px: float
    radii_px: Floats
    """(k,) half sides of the squares; the last is the window's."""

    @classmethod
    def of(cls, shape: tuple[int, ...], psf: PSF) -> _Squares:
        half = min(shape) / 2
        step = max(_SMALLEST_STEP_PX, 2 * half / _STEPS_PER_SIDE)
        count = int(half / step)
        beyond = count + math.ceil(0.5 / step)  # references lie up to half a pixel off the window's centre
        axis = step * np.arange(-beyond, beyond + 1)
        positions = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
        only = replace(psf, samples=psf.samples[:1], index=None)
        spots = np.maximum(only.images(positions, (shape[0], shape[1])), 0.0).reshape(len(positions), -1)
        radii = np.asarray(step * (np.arange(count + 1) + 0.5), np.float64)
        return cls(spots, positions, step, radii)

    def evidence(self, images: Images, scale: float) -> tuple[Floats, float]:
        """Return the likelihood (n, k) of every image averaged over every square, and what to add to logs.

        A pixel's electrons plus its dark variance are taken as Poisson distributed, so that the logarithm of
        the likelihood is linear in them.
        """
        flux = np.maximum(images.flux_e, max(_FAINTEST * images.flux_e.mean(), 1e-3))
        level = np.rint(np.log(flux) / math.log(_FLUX_CLASS))
        middle = np.rint(images.references / self.step_px)
        groups, group_of = np.unique(np.column_stack([level, middle]), axis=0, return_inverse=True)
        pixels = images.pixels_e.reshape(len(flux), -1) / images.excess_noise
        evidence, offset = np.empty((len(flux), len(self.radii_px))), 0.0
        for number, (_, *reference) in enumerate(groups):
            rows = np.flatnonzero(group_of == number)
            electrons = scale * flux[rows].mean() / images.excess_noise
            floor = images.dark_variance_e2 / images.excess_noise + _WEIGHT_FLOOR * electrons
            ring = np.rint(np.abs(self.positions / self.step_px - reference).max(axis=1)).astype(int)
            order = np.argsort(ring, kind="stable")[: np.count_nonzero(ring < len(self.radii_px))]
            counts = np.bincount(ring[order])
            spots = electrons * self.spots[order]
            table = np.log1p(spots / floor).astype(np.float32)
            logs = (pixels[rows] + floor).astype(np.float32) @ table.T - spots.sum(axis=1)
            top = logs.max(axis=1, keepdims=True)
            sums = np.add.reduceat(np.exp(logs - top), np.r_[0, np.cumsum(counts)[:-1]], axis=1)
            evidence[rows] = np.cumsum(sums, axis=1) / np.cumsum(counts)
            offset += float(top.sum())
        return evidence, offset
