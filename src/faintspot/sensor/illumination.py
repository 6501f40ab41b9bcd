"""Which lenslets are lit: decided over the lattice as a whole, not spot by spot.

Every node gives evidence, in standard deviations: does a spot stand out of the noise at the place where it
should be, and does it have enough flux? Neighbours mostly agree, as a pupil is connected (a disk, an
annulus, with spiders), so that disagreement costs something, and the lit set is the one of least cost
altogether: a minimum cut of the lattice's graph, found exactly (Greig, Porteous & Seheult 1989, J. R. Stat.
Soc. B 51, 271). A clear node is never outvoted; a column of doubtful ones is taken or left whole.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse
from numpy.typing import NDArray
from scipy.sparse.csgraph import breadth_first_order, connected_components, maximum_flow

from faintspot.sensor.lattice import Lattice
from faintspot.sensor.nodes import SEARCH, NodeFlux

# Signal-to-noise ratio at which a spot is as likely as not: the highest of the 10 to 20 independent noise
# values within the search area exceeds 3.5 in one unlit cell of 200.
_DETECTED = 3.5
# The evidence of four neighbours (square) or six (hexagonal) together, in standard deviations, and the most
# that one node gives. Neighbours decide about the doubtful; more than twice as much is never outvoted.
_NEIGHBOURS, _CLEAR = 2.0, 5.0
# A spot's place makes a peak of the noise at most this much more or less likely to be one.
_PLACED = 2.0
# Smallest scatter of spots about their nodes (part of the pitch, per axis) that is reckoned with, whatever
# that of the bright ones: aberrations of +-15 % of the pitch have 0.09, spots at the pupil's edge have more.
_SMALLEST_SHIFT = 0.12
# Such aberrations, along both axes, and an error of the lattice move a spot this far from its node; what lies
# beyond, at the rim of the search area (0.35), is mostly the flank of stray light.
_FARTHEST, _RIM = 0.28, 0.02
# Where the part of the reference flux is that divides lit from dark, when it is not given: around 0.3, within
# a factor of 1.7. A lenslet of which half is lit counts as lit; what is scattered and reflected between
# lenslets is mostly less than 0.2.
_FRACTIONS = (0.18, 0.5)
# A lenslet that hangs on a single lit neighbour is a tip of the pupil when it has this part of the flux, else
# a ghost.
_TIP = 0.5
# So small a share of the lenslets near the dividing flux is no reason to choose another.
_FEW = 0.02
# Scatter of the logarithm of the flux of lit spots: what scintillation and speckle make of it.
_SCATTER = (0.1, 0.6)
# A part of the pupil that spiders cut off has at least this share of the largest part's lenslets (four
# quadrants have 1 each); ghosts and cosmic rays have less.
_SHARE = 0.1
# Fluxes within this factor of the dividing one may fall either way; more than this share of the lit lenslets
# with such a flux, or this few standard deviations, are worth a word.
_CLOSE, _DOUBTFUL, _FAINT = 1.25, 0.05, 5.0
# Peaks anywhere in the search area have a median distance from its middle of 0.25 pitch; spots have less.
_SCATTERED = 0.2
# More dim ones among the lit lenslets than this may be a second, dimmer set of spots.
_DIM = 0.3
_PASSES = 4


@dataclass(frozen=True)
class Illumination:
    """Which nodes are lit (n,), and why that may be wrong: one line, empty when it is clear.

    `least_flux` is the flux that divides lit from dark.
    """

    nodes: NDArray[np.bool_]
    doubt: str
    least_flux: float


def find_illumination(spots: NodeFlux, lattice: Lattice, illuminated_fraction: float | None) -> Illumination:
    """Decide which nodes are lit.

    Parameters
    ----------
    spots : NodeLight
    lattice : Lattice
    illuminated_fraction : float, optional
        The smallest flux of a lit lenslet, strictly, as a part of the median of those that are lit without
        it. Default: the part between 0.18 and 0.5 that the fewest have, for most to be clear of it.
    """
    detected = _detection(spots)
    certain = detected > 1
    if not certain.any():
        return Illumination(certain, "", np.inf)
    choose = _Chooser(spots, detected, lattice)
    # Dim spots outside the pupil may be as many as those in it: the start is among the bright ones.
    bright = float(np.quantile(spots.flux[certain], 0.8))
    fraction = _emptiest(spots.flux[detected > 0] / bright)
    illuminated, reference, scatter = choose.settled(bright, fraction)
    if not _spans(spots.cells[illuminated]):
        # A row or two at the pupil's edge: the dimmer row must be lit, as one row makes no sensor.
        fraction = _FRACTIONS[0]
        illuminated, reference, scatter = choose.settled(bright, fraction)
    if illuminated_fraction is not None:
        illuminated = choose.illuminated(reference, max(min(illuminated_fraction, fraction), 1e-6), scatter)
        illuminated &= spots.flux >= illuminated_fraction * reference
        fraction = illuminated_fraction
    return Illumination(
        illuminated, _doubt(spots, illuminated, detected, fraction * reference), fraction * reference
    )


@dataclass(frozen=True)
class _Chooser:
    """Chooses the lit nodes of these spots, with this evidence that they are there."""

    spots: NodeFlux
    detected: NDArray[np.float64]
    lattice: Lattice

    def settled(self, reference: float, fraction: float) -> tuple[NDArray[np.bool_], float, float]:
        """Return the lit nodes, the median of their flux, and the scatter of its logarithm."""
        scatter = _SCATTER[1]
        for _ in range(_PASSES):
            illuminated = self.illuminated(reference, fraction, scatter)
            if not illuminated.any():
                break
            before, reference = reference, float(np.median(self.spots.flux[illuminated]))
            scatter = _log_scatter(self.spots.flux[illuminated])
            if abs(reference / before - 1) < 0.01:
                break
        return illuminated, reference, scatter

    def illuminated(self, reference: float, fraction: float, scatter: float) -> NDArray[np.bool_]:
        """Return the lit nodes, for a dividing flux of a part of the reference."""
        neighbours = self.lattice.neighbours(self.spots.cells)
        links = _links(neighbours)
        relative = np.maximum(self.spots.flux / reference, 1e-6)
        noise = np.minimum(self.spots.flux_noise / reference / relative, 1.0)
        evidence = np.minimum(np.log(relative / fraction) / np.hypot(scatter, noise), self.detected)
        least = _least_cost(evidence, links, _NEIGHBOURS / neighbours.shape[1])
        return _connected(least, links, relative >= _TIP)


def _detection(spots: NodeFlux) -> NDArray[np.float64]:
    """Return the evidence that a spot is at each node: that something is there, and that it is in its place.

    Spots scatter about their nodes as the certain ones do; peaks of noise lie anywhere in the search area,
    those of stray light mostly at its rim.
    """
    ratio = spots.signal_to_noise - _DETECTED
    certain = ratio > 1
    if np.count_nonzero(certain) < 4:
        return ratio
    middle = np.median(spots.shifts.real[certain]) + 1j * np.median(spots.shifts.imag[certain])
    distance = np.abs(spots.shifts - middle)
    # 1.1774 sigma is the median distance of a two-dimensional normal distribution.
    sigma = max(float(np.median(distance[certain])) / 1.1774, _SMALLEST_SHIFT)
    placed = np.log(SEARCH**2 / (2 * sigma**2)) - 0.5 * (distance / sigma) ** 2
    beyond = np.maximum((distance - _FARTHEST) / _RIM, 0.0)
    in_reach = np.where(beyond > 0, -beyond, _CLEAR)
    return np.asarray(np.minimum(ratio + np.clip(placed, -_PLACED, _PLACED), in_reach))


def _emptiest(relative: NDArray[np.float64]) -> float:
    """Return the part of the reference flux that the fewest nodes are near to, in the allowed range."""
    fractions = np.geomspace(*_FRACTIONS, 13)
    # Near: within a factor of 1.25 or so, about the scatter of equally lit lenslets.
    distance = np.log(np.maximum(relative[:, None], 1e-6) / fractions) / np.log(_CLOSE)
    crowd = np.exp(-0.5 * distance**2).sum(axis=0)
    # A few nodes more or less do not matter: then it is the one nearest the middle of the range.
    crowded = np.round(crowd / max(_FEW * len(relative), 0.1))
    return float(fractions[np.lexsort((np.abs(np.arange(13) - 6), crowded))[0]])


def _spans(cells: NDArray[np.int64]) -> bool:
    """Return whether cells are in more than one row and column."""
    return len(cells) > 0 and bool(np.all(np.ptp(cells, axis=0) > 0))


def _log_scatter(flux: NDArray[np.float64]) -> float:
    """Return the robust standard deviation of the logarithm of the flux, within what is plausible."""
    logs = np.log(np.maximum(flux, 1e-300))
    return float(np.clip(1.4826 * np.median(np.abs(logs - np.median(logs))), *_SCATTER))


def _links(neighbours: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the pairs (m, 2) of neighbouring nodes, each once."""
    count = len(neighbours)
    first = np.repeat(np.arange(count), neighbours.shape[1])
    pairs = np.column_stack([first, neighbours.ravel()])
    return np.asarray(pairs[(pairs[:, 0] < pairs[:, 1]) & (pairs[:, 1] < count)])


def _least_cost(evidence: NDArray[np.float64], links: NDArray[np.int64], cost: float) -> NDArray[np.bool_]:
    """Return the lit set of least cost: evidence against the lit and for the dark, and links between the two.

    It is the source's side of the minimum cut, source and sink being joined to the nodes by the evidence for
    and against.
    """
    count = len(evidence)
    source, sink = count, count + 1
    strength = np.rint(100 * np.clip(evidence, -_CLEAR, _CLEAR)).astype(np.int32)
    link = np.full(len(links), round(100 * cost), dtype=np.int32)
    illuminated, dark = np.flatnonzero(strength > 0), np.flatnonzero(strength < 0)
    rows = [np.full(len(illuminated), source), dark, links[:, 0], links[:, 1]]
    columns = [illuminated, np.full(len(dark), sink), links[:, 1], links[:, 0]]
    weights = [strength[illuminated], -strength[dark], link, link]
    graph = scipy.sparse.csr_matrix(
        (np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))), shape=(count + 2,) * 2
    )
    residual = graph - maximum_flow(graph, source, sink).flow
    residual.data = np.maximum(residual.data, 0)
    residual.eliminate_zeros()
    reached = breadth_first_order(residual, source, return_predecessors=False)
    result = np.zeros(count + 2, dtype=bool)
    result[reached] = True
    return result[:count]


def _connected(
    illuminated: NDArray[np.bool_], links: NDArray[np.int64], bright: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Return the lit nodes of the largest connected parts; a tip that hangs on one other must be bright."""
    degree = np.bincount(links[illuminated[links].all(axis=1)].ravel(), minlength=len(illuminated))
    illuminated = illuminated & ((degree >= 2) | ((degree == 1) & bright))
    joined = links[illuminated[links].all(axis=1)]
    graph = scipy.sparse.coo_matrix(
        (np.ones(len(joined)), (joined[:, 0], joined[:, 1])), shape=(len(illuminated),) * 2
    )
    _, part = connected_components(graph, directed=False)
    sizes = np.bincount(part[illuminated], minlength=part.max() + 1)
    return np.asarray(illuminated & (sizes >= max(2, _SHARE * sizes.max()))[part])


def _doubt(
    spots: NodeFlux, illuminated: NDArray[np.bool_], detected: NDArray[np.float64], dividing_flux: float
) -> str:
    """Say in one line when the answer may be wrong."""
    count = int(np.count_nonzero(illuminated))
    if count == 0:
        return ""
    flux = spots.flux[illuminated]
    ratio = float(np.median(spots.signal_to_noise[illuminated]))
    if ratio < _FAINT:
        return f"the spots stand only {ratio:.1f} standard deviations out of the noise; average more frames"
    scattered = float(np.median(np.abs(spots.shifts[illuminated] - np.median(spots.shifts[illuminated]))))
    if scattered > _SCATTERED:
        return (
            f"the spots lie {scattered:.2f} of the pitch from the lattice (median), as peaks anywhere would: "
            "its pitch or geometry may be wrong; give pitch_px"
        )
    close = (detected > 0) & (spots.flux < dividing_flux * _CLOSE) & (spots.flux > dividing_flux / _CLOSE)
    if np.count_nonzero(close) > max(1, _DOUBTFUL * count):
        return (
            f"{np.count_nonzero(close)} lenslets have about {dividing_flux / float(np.median(flux)):.2g} of "
            "the median flux, which divides lit from dark: they may fall either way"
        )
    dim = int(np.count_nonzero(flux < 0.5 * np.quantile(flux, 0.8)))
    if dim > _DIM * count:
        return f"{dim} of the lit lenslets have less than half of the bright ones' flux"
    return ""
