"""Cubic B-splines with a built-in symmetry: what the tables of a trained score are made of."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.slopes.spots.score import nodes_of_pixels

Floats = NDArray[np.float64]

STEPS_PER_PX = 4
"""Table steps per pixel: finer ones change the error by less than 1 %."""

FINE_SPACING_PX, WIDE_SPACING_PX = 0.5, 1.0
"""Node spacings for spots near the diffraction limit, and for wider or speckled ones."""
_FINE_REACH_PX, _WIDE_REACH_PX = 6.0, 8.0

SYMMETRIES = ("round", "aligned", "point")


@dataclass(frozen=True)
class SplineTables:
    """A basis of tables that are odd under the reflection of both axes.

    Parameters
    ----------
    spacing_px : float
        Distance of the spline's nodes.
    n_nodes : int
        Nodes on each side of the middle.
    symmetry : {"round", "aligned", "point"}
        "aligned": odd along the table's own axis and even across, as for spots whose images mirrored in x or
        in y are as likely as they are. "round": the same, and the table for y is that for x transposed.
        "point": only odd when both axes are mirrored at once, as for spots elongated at an angle.
    """

    spacing_px: float
    n_nodes: int
    symmetry: str

    @property
    def n_features(self) -> int:
        """Number of tables in the basis."""
        return self.n_nodes * (self.n_nodes + 1) * (2 if self.symmetry == "point" else 1)

    def odd_and_even(self) -> tuple[Floats, Floats]:
        """Return the odd and even functions at the table's nodes: (table side, functions) each."""
        reach = int(np.ceil((self.n_nodes + 2) * self.spacing_px * STEPS_PER_PX)) - 1
        offset = np.arange(-reach, reach + 1) / (STEPS_PER_PX * self.spacing_px)
        number = np.arange(self.n_nodes + 1)
        right, left = cubic_b_spline(offset[:, None] - number), cubic_b_spline(offset[:, None] + number)
        even = right + left
        even[:, 0] /= 2
        return (right - left)[:, 1:], even

    def features(self, images: NDArray[np.floating[Any]], rounded: Floats) -> tuple[Floats, Floats]:
        """Return the sum over the pixels of each table times the image, for x and for y.

        Parameters
        ----------
        images : (n, ny, nx) array
        rounded : (n, 2) array
            Where the table's middle is, whole table steps, px.

        Returns
        -------
        x, y : (n, n_features) array
        """
        n, ny, nx = images.shape
        odd, even = (np.pad(functions, ((1, 1), (0, 0))) for functions in self.odd_and_even())
        columns = nodes_of_pixels(nx, rounded[:, 0], len(odd), STEPS_PER_PX)
        rows = nodes_of_pixels(ny, rounded[:, 1], len(odd), STEPS_PER_PX)
        along_rows = images @ np.concatenate([odd, even], axis=1)[columns]
        odd_x = along_rows[:, :, : self.n_nodes].transpose(0, 2, 1)
        even_x = along_rows[:, :, self.n_nodes :].transpose(0, 2, 1)
        # One order for both: the odd function's number first, then the even one's.
        x = (odd_x @ even[rows]).reshape(n, -1)
        y = (even_x @ odd[rows]).transpose(0, 2, 1).reshape(n, -1)
        if self.symmetry != "point":
            return x, y
        return np.concatenate([x, y], axis=1), np.concatenate([y, x], axis=1)

    def tables(self, weights_x: Floats, weights_y: Floats) -> NDArray[np.float32]:
        """Return the tables for x and y whose sums are the features times the weights: (2, side, side)."""
        odd, even = self.odd_and_even()

        def table(weights: Floats) -> Floats:
            parts = weights.reshape(-1, self.n_nodes, self.n_nodes + 1)
            sums: Floats = even @ parts[0].T @ odd.T
            return sums if len(parts) == 1 else sums + odd @ parts[1] @ even.T

        return np.stack([table(weights_x), table(weights_y).T]).astype(np.float32)


def splines_for(spacing_px: float, farthest_px: float, symmetry: str) -> SplineTables:
    """Return the basis for a node spacing, no wider than the pixels ever get from the table's middle."""
    reach = min(_WIDE_REACH_PX if spacing_px > FINE_SPACING_PX else _FINE_REACH_PX, farthest_px)
    return SplineTables(spacing_px, math.ceil(reach / spacing_px), symmetry)


def cubic_b_spline(offset: Floats) -> Floats:
    """Return the cubic B-spline with nodes one apart, centred on 0."""
    distance = np.abs(offset)
    inner = 2 / 3 - distance**2 + distance**3 / 2
    outer = np.maximum(2 - distance, 0.0) ** 3 / 6
    return np.where(distance < 1, inner, outer)
