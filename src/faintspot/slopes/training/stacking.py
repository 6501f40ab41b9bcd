"""Stacking registered spots: sums on the fine grid that say all the data know about a PSF."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.slopes.training.registration import FINE, Floats, PSFTables, Registered, Stack, weights


@dataclass(frozen=True)
class Sums:
    """Normal equations of images = flux * PSF(cell) + background, weighted, for one PSF.

    Cells are the nodes of the fine grid, (side, side).
    """

    square: Floats
    """Sum of weight * flux^2."""
    cross: Floats
    """Sum of weight * flux."""
    product: Floats
    """Sum of weight * flux * image."""
    weight: float = 0.0
    """Sum of weight over all pixels, those outside the grid too."""
    image: float = 0.0
    """Sum of weight * image."""

    def combined(self, other: Sums) -> Sums:
        """Return these sums plus another's."""
        return Sums(
            self.square + other.square,
            self.cross + other.cross,
            self.product + other.product,
            self.weight + other.weight,
            self.image + other.image,
        )

    def folded(self, transform: Any) -> Sums:
        """Return the sums with those of a symmetric image of the grid added: half of each."""
        halves = np.stack([0.5 * (plane + transform(plane)) for plane in self.planes])
        return Sums(halves[0], halves[1], halves[2], self.weight, self.image)

    @property
    def planes(self) -> tuple[Floats, Floats, Floats]:
        """The three sums over cells."""
        return self.square, self.cross, self.product


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
    halves_of = [Sums(*planes[:, i], *scalars[:, i]) for i in range(2 * n_psfs)]
    return list(zip(halves_of[::2], halves_of[1::2], strict=True))


def offsets(side: int) -> Floats:
    """Offsets of the fine grid's nodes, px."""
    return (np.arange(side) - (side - 1) / 2) / FINE
