"""Match displaced spots to lattice nodes, from neighbour to neighbour.

An aberration is smooth, so that the displacement of a spot can be extrapolated from its neighbours. Nodes and
spots are matched outwards from the largest part of the lattice in which neighbours agree.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from faintspot.slopes.sensor.detection.lattice import Lattice
from faintspot.slopes.sensor.detection.nodes import REACH
from faintspot.slopes.sensor.region import as_rows, as_tree, links_of

# In pitches: largest distance of a spot from its node where the matching starts, largest difference between
# neighbouring displacements there, and largest distance of a spot from the position extrapolated to it.
_START, _AGREE, _NEAR = 0.3, 0.2, 0.3
# Number of neighbours to which a displacement and its gradient are fitted, and standard deviation (pitches)
# of their Gaussian weights. The ridge (square pitches) keeps the fit to collinear neighbours solvable.
_FITTED, _REACH, _RIDGE = 12, 1.5, 0.1
_ROUNDS = 200  # more than the number of rings of lenslets in any frame


@dataclass(frozen=True, eq=False)
class FollowedDrift:
    """Displacements of spots, extrapolated to any position by a plane through the nearest ones.

    Parameters
    ----------
    nodes, shifts : complex arrays (n,)
        Positions and displacements, x + 1j * y [px].
    pitch_px : float
    """

    nodes: NDArray[np.complex128]
    shifts: NDArray[np.complex128]
    pitch_px: float

    def __call__(self, nodes: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """Return the displacements of spots with nodes at x + 1j * y."""
        distance, near = as_tree(self.nodes).query(as_rows(nodes), min(_FITTED, len(self.nodes)))
        distance, near = distance.reshape(len(nodes), -1) / self.pitch_px, near.reshape(len(nodes), -1)
        weight = np.exp(-0.5 * (distance**2 - distance[:, :1] ** 2) / _REACH**2)
        weight /= weight.sum(axis=1, keepdims=True)
        middle = (weight * self.nodes[near]).sum(axis=1)
        away = (self.nodes[near] - middle[:, None]) / self.pitch_px
        shifts = self.shifts[near]
        x, y = away.real, away.imag
        xx, yy = ((weight * axis**2).sum(axis=1) + _RIDGE for axis in (x, y))
        xy = (weight * x * y).sum(axis=1)
        along, across = ((weight * axis * shifts).sum(axis=1) for axis in (x, y))
        gradient_x = (yy * along - xy * across) / (xx * yy - xy**2)
        gradient_y = (xx * across - xy * along) / (xx * yy - xy**2)
        to = (nodes - middle) / self.pitch_px
        # No farther than the range of the fit, since a plane is unbounded.
        to *= np.minimum(1.0, 2.5 / np.maximum(np.abs(to), 1e-12))
        return np.asarray((weight * shifts).sum(axis=1) + gradient_x * to.real + gradient_y * to.imag)


def follow(
    spots: NDArray[np.complex128], lattice: Lattice, shape: tuple[int, ...]
) -> tuple[Lattice, FollowedDrift] | None:
    """Match spots (n,) x + 1j * y to nodes, and fit the lattice to them.

    Returns
    -------
    (Lattice, FollowedDrift) or None
        None if fewer than four spots agree with a neighbour.
    """
    for _ in range(3):
        cells = lattice.cells_inside(shape, -REACH * lattice.pitch_px)
        of_node = matched_spots(spots, lattice.positions(cells), lattice.neighbours(cells), lattice.pitch_px)
        used = of_node >= 0
        if np.count_nonzero(used) < 4:
            return None
        found = spots[of_node[used]]
        before, lattice = lattice, lattice.fitted(cells[used], found)
        nodes = lattice.positions(cells[used])
        if np.abs(nodes - before.positions(cells[used])).max() < 0.02 * lattice.pitch_px:
            break
        lattice = lattice.canonical(shape)
    return lattice.canonical(shape), FollowedDrift(nodes, found - nodes, lattice.pitch_px)


def matched_spots(
    spots: NDArray[np.complex128],
    nodes: NDArray[np.complex128],
    neighbours: NDArray[np.int64],
    pitch_px: float,
    start: NDArray[np.complex128] | complex = 0.0,
) -> NDArray[np.int64]:
    """Return the index of the spot of each node, -1 if there is none.

    Parameters
    ----------
    spots, nodes : complex arrays (m,), (n,)
        Positions, x + 1j * y [px].
    neighbours : (n, k) array of int
        Table that `neighbours_of` returns.
    pitch_px : float
    start : complex or complex array (n,)
        Displacements near which the matching starts [px].
    """
    tree = as_tree(spots)
    distance, nearest = tree.query(as_rows(nodes + start))
    matched = np.where(distance < _START * pitch_px, nearest, -1)
    matched = _agreeing(spots[matched] - nodes - start, matched, neighbours, _AGREE * pitch_px)
    for _ in range(_ROUNDS):
        used = matched >= 0
        if not used.any():
            break
        drift = FollowedDrift(nodes[used], spots[matched[used]] - nodes[used], pitch_px)
        reached = used | np.append(used, False)[neighbours].any(axis=1)
        distance, nearest = tree.query(as_rows(nodes + drift(nodes)))
        near = reached & (distance < _NEAR * pitch_px)
        before, matched = matched, each_once(np.where(near, nearest, -1), distance)
        if np.array_equal(before, matched):
            break
    return matched


def _agreeing(
    shifts: NDArray[np.complex128],
    matched: NDArray[np.int64],
    neighbours: NDArray[np.int64],
    tolerance_px: float,
) -> NDArray[np.int64]:
    """Keep the matches of the largest part of the lattice in which neighbouring displacements agree."""
    count = len(matched)
    first, second = links_of(neighbours).T
    alike = (matched[first] >= 0) & (matched[second] >= 0)
    alike &= np.abs(shifts[first] - shifts[second]) < tolerance_px
    links = coo_matrix((np.ones(alike.sum()), (first[alike], second[alike])), shape=(count, count))
    _, part = connected_components(links, directed=False)
    return np.where(part == np.bincount(part[matched >= 0], minlength=1).argmax(), matched, -1)


def each_once(matched: NDArray[np.int64], distance: NDArray[np.float64]) -> NDArray[np.int64]:
    """Assign a spot claimed by several nodes to the one with the nearest expected position."""
    order = np.lexsort((distance, matched))
    again = np.zeros(len(matched), dtype=bool)
    again[order[1:]] = matched[order[1:]] == matched[order[:-1]]
    return np.where(again, -1, matched)
