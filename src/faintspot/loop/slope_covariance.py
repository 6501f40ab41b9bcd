"""Covariances of slopes in von Karman turbulence that the wind carries; the order of cells and slopes.

The mean gradient over a square is a difference of the phase along two of its edges, so that all covariances
are sums of the phase structure function D over pairs of edges: cov = 1/2 sum of signs times D. No spectrum
is sampled, and nothing is periodic. Layers are frozen and independent: after a time t, a layer is shifted
by the wind and otherwise unchanged.

Whether cells and slopes are in the same order is seen in the interaction matrix: a mirror makes smooth
surfaces, so it can cancel most of the turbulence that its sensor sees. Of lenslets in a wrong order, or of
axes that are exchanged, it could cancel little more than random slopes would. Neither noise nor the
recording's length matters.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Self

import numpy as np
import scipy
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.errors import InputError
from faintspot.slopes.spots.shapes import R0_WAVELENGTH_M, structure_function

ARCSEC = math.pi / 180 / 3600
OUTER_SCALE_M = 25.0
"""Outer scale expected before telemetry."""
_USUAL_R0_M = 0.15
_SMALLEST, _LARGEST, _NODES = 1e-6, 1e3, 2000  # separations of the table in outer scales
_DIRECTIONS = 8
_POINTS = 6  # of the quadrature along half an edge

Cells = NDArray[np.int64]

_FITS = 0.7
"""Least `smoothness` of a right order: of mirrors of OOPAO, HCIPy, SPECULA and soapy .92 to .98; of wrong
orders 0 to .3, of two pairs of lenslets exchanged .6 to .8. With few polynomials as modes right orders have
.86, wrong ones up to .65."""
_WRONG = 0.4  # below which nothing is learnt
_MOST_SUBAPERTURES, _FEWEST_SUBAPERTURES = 60, 9
_FEWEST_MODES = 5  # without tip and tilt: fewer need not be those with the most turbulence
_OF_NOISE = 3.0  # times the noise's, for modes of turbulence
_OF_TURBULENCE = 0.5, 0.25
"""Like `_FITS` and `_WRONG`, of modes of 500 frames of turbulence: right orders .57 to .79, shuffled ones
up to .05, with axes exchanged .09 to .4, with rows upwards .25 to .38."""
_LEAST = 1e-3  # of the largest singular value, that counts as a mode of the mirror
_OUTER_SCALE = 40.0  # sub-apertures


@dataclass(frozen=True, eq=False)
class SlopeTurbulence:
    """Turbulence and geometry that determine the slopes of a Shack-Hartmann sensor.

    Parameters
    ----------
    positions_m : (n, 2) array
        x (along columns) and y (along rows) of the sub-aperture centres.
    subaperture_m : float
        Side of a sub-aperture.
    pixel_scale_rad : float
        Angle on the sky per pixel.
    r0_m : float
        Fried parameter at 500 nm.
    outer_scale_m : float
        Outer scale L0; infinite for the Kolmogorov spectrum.
    fraction : (layers,) array
        Strength of each layer; only ratios matter.
    wind_m_per_s : (layers, 2) array
        Velocity of each layer along x and y.
    averaged : float
        Side of the square in which a slope is the mean gradient, in sub-apertures. 1: centres of gravity of
        all flux. Near the diffraction limit windows see the least-squares tilt, which varies as the mean
        gradient in a smaller square does.
    length_unit : str
        "m", or what lengths are multiples of where they are unknown in metres.
    """

    positions_m: Floats
    subaperture_m: float
    pixel_scale_rad: float
    r0_m: float
    outer_scale_m: float
    fraction: Floats
    wind_m_per_s: Floats
    averaged: float = 1.0
    length_unit: str = "m"

    @classmethod
    def unmeasured(
        cls,
        cells: NDArray[np.int64],
        subaperture_m: float,
        pixel_scale_arcsec: float,
        outer_scale_m: float | None = None,
        length_unit: str = "m",
    ) -> Self:
        """Return still turbulence of usual strength over sub-apertures, to be measured.

        Parameters
        ----------
        cells : (n, 2) array of int
            Row and column of each sub-aperture.
        subaperture_m, pixel_scale_arcsec : float
        outer_scale_m : float, optional
            Default: that expected before telemetry.
        length_unit : str
        """
        positions = np.asarray(cells[:, ::-1] * subaperture_m, np.float64)
        outer = outer_scale_m or OUTER_SCALE_M
        scale, still = pixel_scale_arcsec * ARCSEC, (np.ones(1), np.zeros((1, 2)))
        return cls(positions, subaperture_m, scale, _USUAL_R0_M, outer, *still, length_unit=length_unit)

    def covariance_px2(self, later_s: float = 0.0) -> Floats:
        """Return E[slopes at t + later_s, slopes at t], (2 n, 2 n) px^2: all x, then all y."""
        return np.asarray(self._covariances_px2((later_s,))[0])

    def lagged_px2(self, frame_s: float) -> Floats:
        """Return `covariance_px2` for delays of 0, 1 and 2 frames, (3, 2 n, 2 n)."""
        return self._covariances_px2((0.0, frame_s, 2 * frame_s))

    def _covariances_px2(self, later_s: Sequence[float]) -> Floats:
        """Return `covariance_px2` for each delay, (delays, 2 n, 2 n); equal shifts of layers count once."""
        part = np.asarray(self.fraction, np.float64) / np.sum(self.fraction)
        (apart_m, separation), wind = self._separations, np.asarray(self.wind_m_per_s, np.float64)
        shifts_m = np.asarray(later_s)[:, None, None] * wind
        distinct_m, of_layer = np.unique(shifts_m.reshape(-1, 2), axis=0, return_inverse=True)
        along, across = (apart_m - distinct_m[:, None]).transpose(2, 0, 1)
        side_m = self.averaged * self.subaperture_m
        covariances = gradient_covariances(along, across, side_m, self.outer_scale_m)
        covariances *= self.r0_m ** (-5 / 3) * self.px2_per_rad2_per_m2
        blocks = [
            np.tensordot(part, covariances[:, shifts], axes=([0], [1]))[:, separation]
            for shifts in of_layer.reshape(shifts_m.shape[:2])
        ]
        return np.array([np.block([[xx, xy], [xy, yy]]) for xx, xy, yy in blocks])

    @cached_property
    def _separations(self) -> tuple[Floats, NDArray[np.int64]]:
        """Distinct separations of sub-apertures (distinct, 2) m, and which of them each pair has, (n, n)."""
        apart_m = (self.positions_m[:, None] - self.positions_m).reshape(-1, 2)
        distinct, separation = np.unique(np.round(apart_m, 9), axis=0, return_inverse=True)
        return distinct, separation.reshape(len(self.positions_m), -1)

    @property
    def px2_per_rad2_per_m2(self) -> float:
        """Squared slope [px] for a gradient of 1 rad/m at 500 nm."""
        return (R0_WAVELENGTH_M / (2 * math.pi) / self.pixel_scale_rad) ** 2

    def layers(self) -> list[Self]:
        """Return each layer separately, with its own strength."""
        part = np.asarray(self.fraction, np.float64) / np.sum(self.fraction)
        return [
            replace(
                self,
                r0_m=self.r0_m * strength ** (-3 / 5),
                fraction=np.ones(1),
                wind_m_per_s=np.asarray(self.wind_m_per_s)[[number]],
            )
            for number, strength in enumerate(part)
            if strength > 0
        ]

    def from_anywhere(self) -> Self:
        """Return the same turbulence with winds of the same speeds, averaged over all directions."""
        angles = 2 * math.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
        around = np.column_stack([np.cos(angles), np.sin(angles)])
        speeds = np.hypot(*np.asarray(self.wind_m_per_s).T)
        winds = (speeds[:, None, None] * around).reshape(-1, 2)
        return replace(self, fraction=np.repeat(self.fraction, _DIRECTIONS), wind_m_per_s=winds)


def gradient_covariances(along: Floats, across: Floats, side_m: float, outer_scale_m: float) -> Floats:
    """Return covariances of mean gradients over squares, (3, ...) rad^2 m^-2 for r0 = 1 m: xx, xy, yy.

    Parameters
    ----------
    along, across : array
        Separations along x and y, m.
    side_m : float
        Side of the squares.
    outer_scale_m : float
    """
    structure = _structure(outer_scale_m)
    return np.array(
        [
            _same_axis(along, across, side_m, structure),
            _both_axes(along, across, side_m, structure),
            _same_axis(across, along, side_m, structure),
        ]
    )


def phase_covariance_rad2(positions_m: Floats, r0_m: float, outer_scale_m: float) -> Floats:
    """Return the covariance of the phase at 500 nm between points, (n, n) rad^2, without an infinite piston.

    Parameters
    ----------
    positions_m : (n, 2) array
        x and y of points in the pupil.
    r0_m : float
        Fried parameter at 500 nm.
    outer_scale_m : float
        Outer scale of the von Karman spectrum; finite.
    """
    structure = _structure(outer_scale_m)
    x, y = (line[:, None] - line for line in positions_m.T)
    far = structure(np.array([(1e3 * outer_scale_m) ** 2]))
    return np.asarray(0.5 * r0_m ** (-5 / 3) * (far - structure(x * x + y * y)))


class _Structure:
    """Phase structure function [rad^2] of the squared separation, for r0 = 1 m."""

    def __init__(self, outer_scale_m: float) -> None:
        self._scale = outer_scale_m
        if math.isfinite(outer_scale_m):
            line = np.geomspace(_SMALLEST, _LARGEST, _NODES)
            self._table = scipy.interpolate.CubicSpline(np.log(line), np.log(structure_function(line, 1.0)))

    def __call__(self, square_m2: Floats) -> Floats:
        square = np.maximum(square_m2, 1e-20)
        if not math.isfinite(self._scale):
            return structure_function(np.sqrt(square), math.inf)
        separation = np.clip(0.5 * np.log(square / self._scale**2), math.log(_SMALLEST), math.log(_LARGEST))
        return np.asarray(np.exp(self._table(separation)) * self._scale ** (5 / 3))


@lru_cache(maxsize=4)
def _structure(outer_scale_m: float) -> _Structure:
    return _Structure(float(outer_scale_m))


def _same_axis(along: Floats, across: Floats, side: float, structure: _Structure) -> Floats:
    """Return the covariance of gradients along the same axis, from parallel edges."""
    nodes, weights = np.polynomial.legendre.leggauss(2 * _POINTS)
    total = np.zeros(along.shape)
    for half in (-0.5, 0.5):  # the density of differences between points of two edges is a triangle
        nodes_m = half * side * (1 + nodes * np.sign(half))
        weight = 0.5 * weights * (1 - np.abs(nodes_m) / side)
        for node, part in zip(nodes_m, weight, strict=True):
            square = (across + node) ** 2
            difference = structure((along + side) ** 2 + square) + structure((along - side) ** 2 + square)
            total += part * (0.5 * difference - structure(along**2 + square))
    return total / side**2


def _both_axes(along: Floats, across: Floats, side: float, structure: _Structure) -> Floats:
    """Return the covariance of gradients along x and y at the separation `along`, `across`."""
    nodes, weights = np.polynomial.legendre.leggauss(_POINTS)
    total = np.zeros(along.shape)
    for on_x, weight_x in zip(0.5 * side * nodes, 0.5 * weights, strict=True):
        for on_y, weight_y in zip(0.5 * side * nodes, 0.5 * weights, strict=True):
            for edge_x in (-1, 1):
                for edge_y in (-1, 1):
                    square = (along + on_x - edge_x * side / 2) ** 2
                    square = square + (across + edge_y * side / 2 - on_y) ** 2
                    total -= 0.5 * edge_x * edge_y * weight_x * weight_y * structure(square)
    return total / side**2


def modes_of_turbulence(slopes: Floats) -> Floats:
    """Return the modes (2 n, k) that stand out of the noise of open-loop slopes (frames, 2 n).

    Unknown slopes are NaN. White noise has covariances of consecutive frames of both signs.
    """
    moving = slopes - np.nanmean(np.where(np.isfinite(slopes).any(axis=0), slopes, 0.0), axis=0)
    moving = np.nan_to_num(moving)
    covariance = moving[1:].T @ moving[:-1]
    values, vectors = np.linalg.eigh(covariance + covariance.T)
    return np.asarray(vectors[:, values > _OF_NOISE * max(-values[0], 0.0)][:, -(len(values) // 4) :])


def order_remark(interaction: Floats, cells: Cells, *, of_turbulence: bool = False) -> str:
    """Return a remark of one line if some cells may not be in the order of the slopes; else nothing.

    `interaction` is that of a mirror, or of the turbulence: `modes_of_turbulence`.

    Raises
    ------
    InputError
        When they are not.
    """
    n = len(cells)
    if n < _FEWEST_SUBAPERTURES or not np.any(interaction):
        return ""
    source, fits_from, wrong_below = "the interaction matrix", _FITS, _WRONG
    if of_turbulence:
        source, (fits_from, wrong_below) = "the turbulence", _OF_TURBULENCE
    stated = smoothness(interaction, cells)
    if stated >= fits_from:
        return ""
    axes = np.roll(np.arange(2 * n), n)
    pairs = np.concatenate([np.arange(0, 2 * n, 2), np.arange(1, 2 * n, 2)])
    by_columns = cells[np.lexsort((cells[:, 0], cells[:, 1]))]
    others: dict[str, list[tuple[Floats, Cells]]] = {
        "by columns, or with y before x": [(interaction, by_columns), (interaction[axes], cells)],
        "with x and y of each sub-aperture in turn": [(interaction[pairs], cells)],
        "with y, or rows, counted upwards": [(interaction, cells * np.array([-1, 1]))],
    }
    fits = {name: max(smoothness(*order) for order in orders) for name, orders in others.items()}
    best = max(fits, key=lambda name: fits[name])
    if fits[best] >= fits_from:
        raise InputError(
            f"cells: {source} fits slopes {best} ({fits[best]:.2f} of 1, as given "
            f"{stated:.2f}); give slopes as all x, then all y, and row and column of each sub-aperture in "
            "that order"
        )
    remark = (
        f"cells: with sub-apertures in this order {source} makes no smooth wavefronts ({stated:.2f} of 1, "
        f"expected {fits_from:g}); check that row and column of each are in the order of the slopes"
    )
    if stated < wrong_below:
        raise InputError(remark)
    return remark


def smoothness(interaction: Floats, cells: Cells) -> float:
    """Return how much turbulence without tip and tilt a mirror cancels: 0 as random modes, 1 the best."""
    n = len(cells)
    if n > _MOST_SUBAPERTURES:
        middle = np.median(cells, axis=0)
        kept = np.argsort(np.square(cells - middle).sum(axis=1), kind="stable")[:_MOST_SUBAPERTURES]
        return smoothness(interaction[np.concatenate([kept, kept + n])], cells[kept])
    positions = np.asarray(cells[:, ::-1], np.float64)
    still = np.ones(1), np.zeros((1, 2))
    covariance = SlopeTurbulence(positions, 1.0, 1.0, 1.0, _OUTER_SCALE, *still).covariance_px2()
    without_tilt = np.kron(np.eye(2), np.eye(n) - 1 / n)
    covariance = without_tilt @ covariance @ without_tilt
    modes, sizes, _ = np.linalg.svd(without_tilt @ interaction, full_matrices=False)
    modes = modes[:, sizes > _LEAST * np.linalg.norm(interaction, 2)]
    if modes.shape[1] < _FEWEST_MODES:
        return 1.0
    best = np.linalg.eigvalsh(covariance)[::-1][: modes.shape[1]].sum()
    random = np.trace(covariance) * modes.shape[1] / (2 * n - 2)
    part = np.einsum("ik,ij,jk->", modes, covariance, modes, optimize=True)
    return float((part - random) / max(best - random, 1e-12 * best))
