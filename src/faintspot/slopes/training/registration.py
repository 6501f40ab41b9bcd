"""Maximum-likelihood positions of thousands of spots with a given PSF, and sums of the registered spots."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.slopes.spots.psf import PSF

Integers = NDArray[np.int64]

FINE = 8
"""Nodes per pixel of the tables that PSFs are read from and stacked on."""

_START_WIDTH = 0.73  # of the spot's FWHM: standard deviation of the smoothing that finds the start
_WEIGHT_FLOOR = 1e-3  # of the flux, in electrons squared: dark wings must not carry huge weights
_BLOCK_PIXELS = 1 << 18
_LARGEST_VARIANCE = 1e4


@dataclass(frozen=True)
class Stack:
    """Images of single spots in photo-electrons, with what is known about their noise."""

    images: NDArray[np.float32]
    """(n, ny, nx); 0 in bad pixels."""
    usable: NDArray[np.bool_] | None
    """(n, ny, nx), None where all pixels are usable."""
    variance_e2: float
    """Variance of a pixel without flux."""
    excess_noise: float
    """Variance for each electron of flux: 1, or 2 behind a multiplication register."""

    def without(self, background_e: Floats) -> Stack:
        """Return the images less a background (n,), whose noise stays."""
        images = self.images - background_e.astype(np.float32)[:, None, None]
        if self.usable is not None:
            images *= self.usable
        noise = self.excess_noise * max(float(background_e.mean()), 0.0)
        return replace(self, images=images, variance_e2=self.variance_e2 + noise)

    def part(self, chosen: slice | NDArray[np.generic]) -> Stack:
        """Return some of the spots."""
        usable = None if self.usable is None else self.usable[chosen]
        return replace(self, images=self.images[chosen], usable=usable)

    def blocks(self) -> Iterator[slice]:
        """Yield blocks of spots whose temporary arrays are small."""
        step = max(1, _BLOCK_PIXELS // int(np.prod(self.images.shape[1:])))
        for start in range(0, len(self.images), step):
            yield slice(start, min(start + step, len(self.images)))


@dataclass(frozen=True)
class PSFTables:
    """PSFs and their slopes at every `FINE`-th of a pixel, with a border of zeros: (n_psfs, side, side)."""

    value: NDArray[np.float32]
    slope_x: NDArray[np.float32]
    slope_y: NDArray[np.float32]

    @classmethod
    def of(cls, psf: PSF, radius_px: int) -> PSFTables:
        """Read a PSF on the fine grid, out to a radius."""
        side = 2 * radius_px + 3
        phases = np.arange(FINE) / FINE
        moved = -np.stack(np.meshgrid(phases, phases, indexing="xy"), axis=-1).reshape(-1, 2)
        planes = []
        for plane in range(len(psf.samples)):
            phase_images = psf.images(moved, (side, side), which=plane).reshape(FINE, FINE, side, side)
            fine = phase_images.transpose(2, 0, 3, 1).reshape(side * FINE, side * FINE)
            planes.append(fine[: 1 - FINE, : 1 - FINE])
        value = np.stack(planes)
        slope_y, slope_x = (np.asarray(np.gradient(value, 1.0 / FINE, axis=axis)) for axis in (1, 2))
        return cls(value.astype(np.float32), slope_x.astype(np.float32), slope_y.astype(np.float32))

    @property
    def middle(self) -> int:
        """Row and column of offset 0."""
        return int(self.value.shape[1] - 1) // 2

    def cells(self, shape: tuple[int, ...], positions: Floats) -> tuple[Integers, Integers]:
        """Return row (n, ny) and column (n, nx) of the table for the pixels of spots at these positions."""
        nearest = np.rint(positions * FINE).astype(np.int64)
        rows, columns = (
            np.clip(
                (FINE * np.arange(n) - FINE * (n - 1) // 2) - nearest[:, axis, None] + self.middle,
                0,
                2 * self.middle,
            )
            for n, axis in zip(shape, (1, 0), strict=True)
        )
        return rows, columns


@dataclass(frozen=True)
class Registered:
    """Position (n, 2), flux (n,) and the positions' covariance (n, 2, 2) of spots."""

    positions: Floats
    flux_e: Floats
    covariance: Floats

    @property
    def error_px(self) -> Floats:
        """Standard error of the position along x and y, (n, 2)."""
        error: Floats = np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))
        return error

    def part(self, chosen: slice | NDArray[np.generic]) -> Registered:
        """Return some of the spots."""
        return Registered(self.positions[chosen], self.flux_e[chosen], self.covariance[chosen])

    @classmethod
    def joined(cls, parts: Sequence[Registered]) -> Registered:
        """Return the spots of all parts, in order."""
        names = ("positions", "flux_e", "covariance")
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))

    def draw(self, rng: np.random.Generator) -> Floats:
        """Return positions drawn from what the images leave possible."""
        a, b, c = self.covariance[:, 0, 0], self.covariance[:, 0, 1], self.covariance[:, 1, 1]
        first, second = rng.standard_normal((2, len(a)))
        root = np.sqrt(a)
        y = b / root * first + np.sqrt(np.maximum(c - b * b / a, 0)) * second
        drawn: Floats = self.positions + np.stack([root * first, y], axis=1)
        return drawn


def start(stack: Stack, tables: PSFTables, index: Integers, fwhm_px: Floats, search_px: float) -> Registered:
    """Return the largest pixel of the smoothed images, with the flux its height tells."""
    n, ny, nx = stack.images.shape
    positions, flux = np.zeros((n, 2)), np.ones(n)
    offset_y, offset_x = (np.arange(side) - (side - 1) / 2 for side in (ny, nx))
    allowed = (np.abs(offset_y)[:, None] <= search_px + 0.5) & (np.abs(offset_x) <= search_px + 0.5)
    for kind in np.unique(index):
        spots = np.flatnonzero(index == kind)
        std = _START_WIDTH * fwhm_px[kind, ::-1]
        smoothed = scipy.ndimage.gaussian_filter(
            stack.images[spots], std, mode="constant", axes=(1, 2), truncate=2.5
        )
        flat = np.where(allowed, smoothed, -np.inf).reshape(len(spots), -1)
        best = np.argmax(flat, axis=1)
        row, column = np.divmod(best, nx)
        positions[spots] = np.stack([offset_x[column], offset_y[row]], axis=1)
        height = scipy.ndimage.gaussian_filter(
            tables.value[kind], std * FINE, mode="constant", truncate=2.5
        ).max()
        flux[spots] = np.maximum(flat[np.arange(len(spots)), best] / height, 1.0)
    return Registered(positions, flux, np.full((n, 2, 2), np.inf))


def register(
    stack: Stack, tables: PSFTables, index: Integers, spots: Registered, search_px: float, steps: int
) -> Registered:
    """Return positions and fluxes after that many steps of Fisher scoring from those of `spots`.

    The PSF is read at the nearest node of the fine grid and the step taken from there: exact at convergence
    up to second order in a sixteenth of a pixel.
    """
    parts: list[Registered] = []
    for block in stack.blocks():
        part, refined = stack.part(block), spots.part(block)
        for _ in range(steps):
            refined = _fisher_step(part, tables, index[block], refined, search_px)
        parts.append(refined)
    return Registered.joined(parts)


def weights(stack: Stack, model: NDArray[np.generic], flux: Floats) -> NDArray[np.float32]:
    """Return one over the variance of every pixel under a model of the flux; 0 in bad pixels."""
    floor = (stack.variance_e2 + _WEIGHT_FLOOR * flux).astype(np.float32)
    result = 1 / (floor[:, None, None] + np.float32(stack.excess_noise) * np.maximum(model, 0))
    return result if stack.usable is None else result * stack.usable  # type: ignore[no-any-return]


def _fisher_step(
    stack: Stack, tables: PSFTables, kinds: Integers, spots: Registered, search_px: float
) -> Registered:
    """One step in x, y and flux, each bounded; the covariance is that at the step's start."""
    positions, flux = spots.positions, spots.flux_e
    rows, columns = tables.cells(stack.images.shape[1:], positions)
    node = np.rint(positions * FINE) / FINE
    side = tables.value.shape[1]
    cell = (kinds[:, None] * side + rows)[:, :, None] * side + columns[:, None, :]
    shape = tables.value.take(cell)
    per_spot = -flux.astype(np.float32)[:, None, None]
    model = -per_spot * shape
    weight = weights(stack, model, flux)
    derivatives = [tables.slope_x.take(cell) * per_spot, tables.slope_y.take(cell) * per_spot, shape]
    residual = weight * (stack.images - model)
    information = np.empty((len(flux), 3, 3))
    score = np.empty((len(flux), 3))
    for a, derivative in enumerate(derivatives):
        score[:, a] = np.einsum("ijk,ijk->i", residual, derivative)
        weighted = weight * derivative
        for b in range(a, 3):
            information[:, a, b] = np.einsum("ijk,ijk->i", weighted, derivatives[b])
            information[:, b, a] = information[:, a, b]
    # A spot outside its window tells nothing: its matrix must stay invertible.
    information[:, range(3), range(3)] += [1 / _LARGEST_VARIANCE, 1 / _LARGEST_VARIANCE, 1e-12]
    inverse = np.linalg.inv(information).astype(np.float64)
    step = np.einsum("iab,ib->ia", inverse, score)
    moved = np.clip(node + np.clip(step[:, :2], -1, 1), -search_px, search_px)
    brighter = np.clip(flux + step[:, 2], np.maximum(flux / 2, 1e-3), np.maximum(2 * flux, 1e-3))
    return Registered(moved, brighter, inverse[:, :2, :2])


@dataclass(frozen=True)
class Sums:
    """Normal equations of images = flux * PSF(cell) + background, weighted, for one PSF.

    Cells are the nodes of the fine grid, (side, side).
    """

    planes: Floats
    """Sums of weight * flux^2, weight * flux and weight * flux * image, (3, side, side)."""
    weight: float
    """Sum of weight over all pixels, those outside the grid too."""
    image: float
    """Sum of weight * image."""

    def combined(self, other: Sums) -> Sums:
        """Return these sums plus another's."""
        return Sums(self.planes + other.planes, self.weight + other.weight, self.image + other.image)

    def transposed(self) -> Sums:
        """Return the sums with rows and columns exchanged."""
        return replace(self, planes=self.planes.swapaxes(1, 2))

    def folded(self, symmetric: Floats) -> Sums:
        """Return the mean of these sums and `symmetric`, those of a symmetric image of the grid."""
        return replace(self, planes=0.5 * (self.planes + symmetric))


def stack_spots(
    stack: Stack,
    tables: PSFTables,
    index: NDArray[np.generic],
    registered: Registered,
    background_e: Floats,
    halves: NDArray[np.bool_],
    draws: int,
    rng: np.random.Generator,
) -> list[tuple[Sums, Sums]]:
    """Add up the spots of every PSF, in two halves of the spots.

    Every spot is put not where it was measured but where it may be, `draws` times: noise moves a measured
    position towards the pixels it made brighter, and spots stacked there would come out too sharp. (It is the
    expectation step of expectation maximisation, by Monte Carlo.)
    """
    side, n_psfs = tables.value.shape[1], len(tables.value)
    sums = np.zeros((3, 2 * n_psfs * side * side))
    scalars = np.zeros((2, 2 * n_psfs))
    level = np.maximum(background_e, 0)[index, None, None]
    for block in stack.blocks():
        part, flux = stack.part(block), registered.flux_e[block]
        spots = registered.part(block)
        group = 2 * index[block] + halves[block]
        for _ in range(draws):
            rows, columns = tables.cells(part.images.shape[1:], spots.draw(rng))
            cell = rows[:, :, None] * side + columns[:, None, :]
            model = tables.value.take(index[block][:, None, None] * side**2 + cell) * flux[:, None, None]
            weight = weights(part, model + level[block], flux) / draws
            cell += group[:, None, None] * side**2
            weighted = weight * flux[:, None, None]
            for row, values in enumerate((weighted * flux[:, None, None], weighted, weighted * part.images)):
                sums[row] += np.bincount(cell.ravel(), values.ravel(), sums.shape[1])
            for row, values in enumerate((weight, weight * part.images)):
                scalars[row] += np.bincount(group, values.sum(axis=(1, 2)), 2 * n_psfs)
    planes = sums.reshape(3, 2 * n_psfs, side, side)
    planes[:, :, [0, -1], :] = planes[:, :, :, [0, -1]] = 0  # pixels outside the grid
    halves_of = [Sums(planes[:, i], *scalars[:, i]) for i in range(2 * n_psfs)]
    return list(zip(halves_of[::2], halves_of[1::2], strict=True))


def offsets(side: int) -> Floats:
    """Offsets of the fine grid's nodes, px."""
    return (np.arange(side) - (side - 1) / 2) / FINE
