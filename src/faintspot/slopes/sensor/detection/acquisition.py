"""Match the spots of one frame to the known nodes of a layout, under an unknown low-order aberration.

Displacements that are linear in the position (tilt, defocus, astigmatism) are tried all together: for each,
the nodes that would have a spot are counted in a map of the distance to the nearest spot. The best ones
start the matching from neighbour to neighbour, which also finds what is not linear.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from faintspot.slopes.sensor.detection.following import FollowedDrift, each_once, matched_spots
from faintspot.slopes.sensor.detection.nodes import REACH, SpotFlux
from faintspot.slopes.sensor.region import as_rows, as_tree, links_of

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
    of_node: NDArray[np.int64],
    spots: NDArray[np.complex128],
    nodes: NDArray[np.complex128],
    pitch_px: float,
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
