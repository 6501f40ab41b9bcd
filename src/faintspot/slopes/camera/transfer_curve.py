"""Photon-transfer curve: variance of pixels against their mean, from frames with constant flux."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.checks import numbers_between
from faintspot.base.errors import InputError
from faintspot.slopes.sensor.layout import Layout

_TILE = 16  # side of the parts of a frame that are assumed to move together, px
_GROUPS = 16  # of pixels, for standard errors
_ITERATIONS = 20
_LARGEST_EXCESS = 10.0  # times the expected variance: pixels above it are ignored as flickering


class TransferCurve(NamedTuple):
    """Photon-transfer curve, one point per pixel: expected variance = intercept * share + slope * flux."""

    variance: Floats
    share: Floats  # fraction of its own variance left after common changes are removed
    flux: Floats  # mean above the dark level, weighted likewise
    mean: Floats  # plain mean above the dark level
    degrees: float  # degrees of freedom of each variance

    def within(self, range_adu: tuple[float, float] | None) -> TransferCurve:
        """Return the pixels whose mean above the dark level is in a range (lowest, highest); None: all."""
        if range_adu is None:
            return self
        limits = numbers_between("range_adu", range_adu)
        if limits.shape != (2,) or limits[0] >= limits[1]:
            raise InputError(f"range_adu: expected (lowest, highest), got {range_adu!r}")
        inside = (self.mean >= limits[0]) & (self.mean <= limits[1])
        if np.count_nonzero(inside) < 2 * _GROUPS:
            raise InputError(f"range_adu = {range_adu!r}: expected at least {2 * _GROUPS} pixels in it")
        return self._chosen(inside)

    def _chosen(self, pixels: NDArray[np.bool_]) -> TransferCurve:
        variance, share, flux, mean = (values[pixels] for values in self[:4])
        return TransferCurve(variance, share, flux, mean, self.degrees)

    def halves(self) -> tuple[TransferCurve, TransferCurve]:
        """Split the pixels so that the fainter ones have half of the flux."""
        order = np.argsort(self.mean)
        collected = np.cumsum(np.maximum(self.mean[order], 0.0))
        split = self.mean[order][np.searchsorted(collected, 0.5 * collected[-1])]
        return self._chosen(self.mean < split), self._chosen(self.mean >= split)


class LineFit(NamedTuple):
    """Line through the points of a curve."""

    slope: float
    slope_error: float
    scatter: float  # mean square of bright pixels about the line, 1 for normal noise


def photon_transfer(
    frames: Floats, dark_level: float | Floats, layout: Layout | None, order: int = 2
) -> TransferCurve:
    """Return the variance of each pixel after removal of the common changes of its tile.

    The residual of a fit with orthonormal modes Q has the variance sum_j (1 - Q Q')_ij^2 v_j, which is
    computed for v = 1 (`share`) and v = flux.
    """
    mean = frames.mean(axis=0)
    flux = np.broadcast_to(mean - dark_level, mean.shape)
    slope_y, slope_x = _derivative(mean, 0), _derivative(mean, 1)
    seconds = [_derivative(slope_y, 0), _derivative(slope_y, 1), _derivative(slope_x, 1)]
    maps = np.stack([flux, slope_x, slope_y, *seconds][: 3 * order], axis=-1)
    differences = np.diff(frames, axis=0)
    parts = []
    for tile in _tiles(mean.shape, layout):
        tile_flux = flux[tile].ravel()
        vectors, size, _ = np.linalg.svd(maps[tile].reshape(len(tile_flux), -1), full_matrices=False)
        modes = vectors[:, size > 1e-9 * max(float(size[0]), 1e-300)]
        change = differences[(slice(None), *tile)].reshape(len(differences), -1)
        residual = change - (change @ modes) @ modes.T
        leverage = np.sum(np.square(modes), axis=1)
        spread = np.sum((modes @ (modes.T @ (tile_flux[:, None] * modes))) * modes, axis=1)
        variance = 0.5 * np.mean(np.square(residual), axis=0)
        parts.append((variance, 1 - leverage, tile_flux * (1 - 2 * leverage) + spread, tile_flux))
    n = len(differences)
    # Successive differences share a frame: their squares are correlated by 1/4.
    variance, share, weighted, plain = (np.concatenate(values) for values in zip(*parts, strict=True))
    return TransferCurve(variance, share, weighted, plain, n**2 / (1.5 * n - 0.5))


def _derivative(image: Floats, axis: int) -> Floats:
    """Return the derivative per pixel of a quintic spline, which suits critically sampled spots."""
    coefficients = np.moveaxis(scipy.ndimage.spline_filter1d(image, 5, axis=axis, mode="mirror"), axis, 0)
    c = np.pad(coefficients, ((2, 2), (0, 0)), mode="reflect")
    slope: Floats = (10 * (c[3:-1] - c[1:-3]) + c[4:] - c[:-4]) / 24
    return np.moveaxis(slope, 0, axis)


def _tiles(shape: tuple[int, ...], layout: Layout | None) -> list[tuple[slice, slice]]:
    """Return the windows of the layout, or tiles that cover the frame."""
    if layout is not None:
        if layout.frame_shape != shape:
            raise InputError(f"frames: expected the layout's shape {layout.frame_shape}, got {shape}")
        height, width = layout.window
        return [(slice(r, r + height), slice(c, c + width)) for r, c in layout.corners]
    rows, columns = (np.linspace(0, side, max(1, side // _TILE) + 1).astype(int) for side in shape)
    return [
        (slice(top, bottom), slice(start, stop))
        for top, bottom in pairwise(rows)
        for start, stop in pairwise(columns)
    ]


def fit_line(curve: TransferCurve) -> LineFit | None:
    """Fit variance = intercept * share + slope * flux; standard errors by jackknife over groups of pixels."""
    terms = np.stack([curve.share, curve.flux], axis=1)
    n = len(terms)
    varies = curve.variance > 0
    if min(n, int(np.count_nonzero(varies))) < 2 * _GROUPS or np.ptp(curve.mean) == 0:
        return None
    least = 0.1 * float(np.median(curve.variance[varies]))
    # Weights must not follow the noise of faint pixels: below the typical flux they are equal.
    bright = max(float(np.sum(np.square(curve.mean)) / max(np.sum(np.abs(curve.mean)), 1e-300)), 0.0)
    typical = np.maximum(curve.mean, bright)
    model: Floats = np.full(n, np.inf)
    scale: Floats = np.ones(n)
    for _ in range(_ITERATIONS):
        good = (curve.variance > 0) & (curve.variance < _LARGEST_EXCESS * model)
        weight = good / np.square(scale)
        solution = _solve(terms * weight[:, None], terms, curve.variance)
        model = np.maximum(terms @ solution, least)
        scale = np.maximum(solution[0] + solution[1] * typical, least)
    weighted = terms * weight[:, None]
    group = np.arange(n) * _GROUPS // n
    subsets = [group != left_out for left_out in range(_GROUPS)]
    without = np.array([_solve(weighted[k], terms[k], curve.variance[k]) for k in subsets])
    error = math.sqrt((_GROUPS - 1) * float(np.var(without[:, 1])))
    counted = good & (curve.mean >= bright)
    scatter = np.mean(np.square(curve.variance / model - 1)[counted]) if counted.any() else 0.0
    return LineFit(float(solution[1]), error, float(scatter) * curve.degrees / 2)


def _solve(weighted: Floats, terms: Floats, variance: Floats) -> Floats:
    solution = np.linalg.lstsq(weighted.T @ terms, weighted.T @ variance, rcond=None)[0]
    return np.asarray(solution, dtype=np.float64)
