"""Match the spots of one frame to the known nodes of a layout, under an unknown low-order aberration.

Displacements that are linear in the position (tilt, defocus, astigmatism) are tried all together: for each,
the nodes that would have a spot are counted in a map of the distance to the nearest spot. The best ones
start the matching from neighbour to neighbour, which also finds what is not linear.
"""

import itertools
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from faintspot.slopes.sensor.detection.candidates import Lattice
from faintspot.slopes.sensor.detection.nodes import REACH, SpotFlux
from faintspot.slopes.sensor.region import as_rows, as_tree, links_of

# In pitches: largest distance of a spot from its node where the matching starts, largest difference between
# neighbouring displacements there, and largest distance of a spot from the position extrapolated to it.
_START, _AGREE, _NEAR_NODE = 0.3, 0.2, 0.3
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
        near = reached & (distance < _NEAR_NODE * pitch_px)
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
    links = scipy.sparse.coo_matrix(
        (np.ones(alike.sum()), (first[alike], second[alike])), shape=(count, count)
    )
    _, part = scipy.sparse.csgraph.connected_components(links, directed=False)
    return np.where(part == np.bincount(part[matched >= 0], minlength=1).argmax(), matched, -1)


def each_once(matched: NDArray[np.int64], distance: NDArray[np.float64]) -> NDArray[np.int64]:
    """Assign a spot claimed by several nodes to the one with the nearest expected position."""
    order = np.lexsort((distance, matched))
    again = np.zeros(len(matched), dtype=bool)
    again[order[1:]] = matched[order[1:]] == matched[order[:-1]]
    return np.where(again, -1, matched)


# Pitches: steps of the tilts that are tried (twice that for defocus, at the edge of the pupil), sizes of
# astigmatism, and largest distance of a spot from where one expects it.
_STEP, _ASTIGMATISM, _NEAR = 0.25, (0.4, 0.8, 1.2), 0.25
_MOST_NODES = 200  # for which displacements are compared
# Displacements from which the matching starts, those among which they are chosen, and their least rms
# difference (pitches).
_TRIED, _COMPARED, _DIFFERENT = 24, 4000, 0.3
# Largest distance (pitches) of a spot that no node has from the extrapolated position of a node without one.
_LEFT = 0.6
# The score of a match, in rows of spots across the pupil, is the number of spots with a node. Each pitch of
# rms displacement costs 0.4: less than the row that an error of a pitch loses at the edge of the pupil.
# Neighbours whose displacements differ by more than 0.7 pitch show an error, and cost half a spot.
_PREFERRED, _BROKEN, _COST = 0.4, 0.7, 0.5
# Another match has a median difference of more than half a pitch. Of 1.5 pitches of Zernike modes up to the
# fifth order, matches with a smaller margin of the score were often wrong, none with a larger one.
# Median displacements below 0.35 pitch need none: an array larger than the layout looks the same a pitch on.
_OTHER, _MARGIN, _SMALL = 0.5, 0.4, 0.35
_FEWEST = 4  # spots


@dataclass(frozen=True)
class Acquired:
    """Displacements of the spots of one frame.

    Parameters
    ----------
    displacements : complex array (n,)
        Displacement of the spot of each node [px]; NaN where none was found.
    certain : bool
        Whether most spots are near where they were expected, or no other match, with most spots at other
        nodes, explains the frame nearly as well.
    """

    displacements: NDArray[np.complex128]
    certain: bool

    @property
    def found(self) -> NDArray[np.bool_]:
        """Whether each node has a spot."""
        return np.isfinite(self.displacements)

    def completed(self, nodes: NDArray[np.complex128], pitch_px: float) -> NDArray[np.complex128]:
        """Return the displacements, with those that were not found extrapolated from their neighbours."""
        drift = FollowedDrift(nodes[self.found], self.displacements[self.found], pitch_px)
        return np.where(self.found, self.displacements, drift(nodes))


def acquire(
    spots: SpotFlux,
    nodes: NDArray[np.complex128],
    neighbours: NDArray[np.int64],
    pitch_px: float,
    shape: tuple[int, ...],
    expected: NDArray[np.complex128],
    *,
    bent: bool = True,
) -> Acquired | None:
    """Match all spots of a frame to the nodes of a layout; return None if hardly any match.

    Parameters
    ----------
    spots : SpotFlux
    nodes : complex array (n,)
        Reference positions of the lenslets, x + 1j * y [px].
    neighbours : (n, k) array of int
        Table that `neighbours_of` returns.
    pitch_px : float
    shape : (int, int)
        Height and width of the frame.
    expected : complex array (n,)
        Displacements around which to search [px].
    bent : bool
        Whether to search for defocus and astigmatism, too; otherwise only for a common displacement.
    """
    if len(spots.positions) < _FEWEST:
        return None
    links, row = links_of(neighbours), np.sqrt(len(nodes))
    weight = np.clip(spots.flux / np.median(spots.flux), 0.0, 1.0)  # dim ones may be beyond the layout
    scores, matches = [], []
    for trial in _trials(spots.positions, nodes + expected, pitch_px, shape, bent):
        of_node = matched_spots(spots.positions, nodes, neighbours, pitch_px, expected + trial)
        if np.count_nonzero(of_node >= 0) < _FEWEST:
            continue
        of_node = _with_rest(of_node, spots.positions, nodes, pitch_px)
        used = of_node >= 0
        found = np.where(used, spots.positions[of_node] - nodes, complex(np.nan, np.nan))
        moved = np.sqrt(np.mean(np.abs(found - expected)[used] ** 2)) / pitch_px
        first, second = found[links].T
        broken = np.count_nonzero(np.abs(first - second) > _BROKEN * pitch_px)
        scores.append((float(weight[of_node[used]].sum()) - _COST * broken) / row - _PREFERRED * moved)
        matches.append(found)
    if not scores:
        return None
    best = int(np.argmax(scores))
    differs = [np.nanmedian(np.append(np.abs(other - matches[best]), 0.0)) for other in matches]
    rival = np.array(differs) > _OTHER * pitch_px
    most = np.max(np.array(scores)[rival], initial=0.0)
    is_near = np.nanmedian(np.abs(matches[best] - expected)) < _SMALL * pitch_px
    return Acquired(matches[best], bool(is_near or scores[best] - most > _MARGIN))


def _with_rest(
    of_node: NDArray[np.int64], spots: NDArray[np.complex128], nodes: NDArray[np.complex128], pitch_px: float
) -> NDArray[np.int64]:
    """Match the spots that are left to the nodes that are left, where an aberration bends most."""
    used = of_node >= 0
    rest = np.setdiff1d(np.arange(len(spots)), of_node)
    if used.all() or not len(rest):
        return of_node
    drift = FollowedDrift(nodes[used], spots[of_node[used]] - nodes[used], pitch_px)
    empty = np.flatnonzero(~used)
    distance, nearest = as_tree(spots[rest]).query(as_rows(nodes[empty] + drift(nodes[empty])))
    filled = of_node.copy()
    filled[empty] = each_once(np.where(distance < _LEFT * pitch_px, rest[nearest], -1), distance)
    return filled


def _trials(
    spots: NDArray[np.complex128],
    nodes: NDArray[np.complex128],
    pitch_px: float,
    shape: tuple[int, ...],
    bent: bool,
) -> list[NDArray[np.complex128]]:
    """Return the displacements (n,) for which most nodes have a spot, best first."""
    away = nodes - nodes.mean()
    away /= max(np.abs(away).max() / pitch_px, 1.0)  # 1 pitch at the edge of the pupil
    axis = np.arange(-REACH, REACH + 1e-9, _STEP)
    tilts = np.array([complex(x, y) for x in axis for y in axis if np.hypot(x, y) <= REACH])
    turns = [0.0, *(size * np.exp(0.25j * np.pi * k) for size in _ASTIGMATISM for k in range(8))]
    linear = np.array(list(itertools.product(axis[::2], turns))) if bent else np.zeros((1, 2))
    shapes = linear[:, :1] * away + linear[:, 1:] * away.conj()
    chosen = slice(None, None, -(-len(nodes) // _MOST_NODES))
    distance = _distance_to_spots(spots, shape)
    count = np.empty((len(shapes), len(tilts)))
    for index, bend in enumerate(shapes):
        at = nodes[chosen] + bend[chosen] + pitch_px * tilts[:, None]
        y = np.clip(np.rint(at.imag), 0, shape[0] - 1).astype(np.int64)
        x = np.clip(np.rint(at.real), 0, shape[1] - 1).astype(np.int64)
        count[index] = (distance[y, x] < _NEAR * pitch_px).sum(axis=1)
    order = np.argsort(-count, axis=None, kind="stable")[:_COMPARED]
    trials: list[NDArray[np.complex128]] = []
    for shape_index, tilt_index in zip(*np.divmod(order, len(tilts)), strict=True):
        trial = shapes[shape_index] + pitch_px * tilts[tilt_index]
        least = (_DIFFERENT * pitch_px) ** 2
        if all(np.mean(np.abs(trial - other) ** 2) > least for other in trials):
            trials.append(trial)
        if len(trials) == _TRIED:
            break
    return trials


def _distance_to_spots(spots: NDArray[np.complex128], shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Return the distance of each pixel from the nearest spot."""
    empty = np.ones(shape, bool)
    y = np.clip(np.rint(spots.imag), 0, shape[0] - 1).astype(np.int64)
    x = np.clip(np.rint(spots.real), 0, shape[1] - 1).astype(np.int64)
    empty[y, x] = False
    return np.asarray(scipy.ndimage.distance_transform_edt(empty))
