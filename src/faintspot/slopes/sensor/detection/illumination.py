"""Choice of the illuminated lenslets for the whole lattice at once, not spot by spot.

Each node provides evidence, in standard deviations: a spot stands out of the noise at its expected
position, and has enough flux. Neighbours mostly agree, since a pupil is connected (disk, annulus, spiders),
so that a difference between neighbours has a cost. The chosen set has the least total cost, found exactly
as a minimum cut of the lattice graph (Greig, Porteous & Seheult 1989, J. R. Stat. Soc. B 51, 271). Clear
evidence of a node is never overruled; a column of doubtful nodes is included or excluded as a whole.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from faintspot.base.statistics import MAD_TO_STD, mad_std
from faintspot.slopes.sensor.detection.candidates import Lattice
from faintspot.slopes.sensor.detection.nodes import SEARCH, NodeFlux, SpotFlux
from faintspot.slopes.sensor.region import links_of

# Signal-to-noise ratio at which a spot is as likely as not: the highest of the 10 to 20 independent noise
# values within the search area exceeds 3.5 in one dark cell of 200.
_DETECTED = 3.5
# Weight of four (square) or six (hexagonal) neighbours together, in standard deviations, and maximum evidence
# of one node. Neighbours decide on doubtful nodes; evidence of more than twice the weight is never overruled.
_NEIGHBOURS, _CLEAR = 2.0, 5.0
# Maximum factor by which the position of a peak changes the likelihood that it is a spot.
_PLACED = 2.0
# Lower limit of the assumed scatter of spots about their nodes (in pitches, per axis): aberrations of
# +-15 % of the pitch have 0.09, and spots at the edge of the pupil have more than the bright ones.
_SMALLEST_SHIFT = 0.12
# Maximum displacement of a spot from its node by such aberrations along both axes and by an error of the
# lattice. Peaks farther out, up to the search radius of 0.35, are mostly due to stray light, unless their
# signal-to-noise ratio is as high as this.
_FARTHEST, _FARTHEST_BRIGHT, _RIM, _BRIGHT = 0.28, 0.33, 0.02, 20.0
# Fraction of the reference flux that separates illuminated from dark, if it is not given: around 0.3, within
# a factor of 1.7. A half-illuminated lenslet counts as illuminated; light scattered and reflected between
# lenslets is mostly less than 0.2.
_FRACTIONS = (0.18, 0.5)
# A lenslet with a single illuminated neighbour is a tip of the pupil if it has this fraction of the flux,
# otherwise a ghost.
_TIP = 0.5
# Such a small share of lenslets near the dividing flux does not justify another one.
_FEW = 0.02
# Scatter of the logarithm of the flux of illuminated spots, due to scintillation and speckle.
_SCATTER = (0.1, 0.6)
# Least size of a part of the pupil separated by spiders, relative to the largest part (1 for each of four
# quadrants); ghosts and cosmic rays are smaller.
_SHARE = 0.1
# Lenslets with flux within this factor of the dividing flux are ambiguous; a warning is given if their share
# of the illuminated ones exceeds this limit, or if spots are less significant than this.
_CLOSE, _DOUBTFUL, FAINT = 1.25, 0.15, 6.0
# Peaks distributed over the search area have a median distance of 0.25 pitch from its centre; spots have
# less.
_SCATTERED = 0.2
# The flux is that of a Gaussian beam if this explains so much of the variance of its logarithm, in so many
# spots. Passes of its fit, least scatter of the logarithm, and outliers in units of it.
_BEAM, _FEWEST_FOR_BEAM = 0.9, 12
_FITS, _LEAST_SCATTER, _OUTLIER = 6, 0.05, 4.0
# Standard error of a position [px] below which a spot is measurable: 0.1 px, and the error of the estimate.
# Least fraction of the squared flux that the shape explains, relative to illuminated spots.
_MEASURABLE_PX, LIKE = 0.14, 0.6
# Share of dim lenslets among the illuminated ones above which there may be a second, dimmer set of spots.
_DIM = 0.4
_PASSES = 4


@dataclass(frozen=True)
class Illumination:
    """Illuminated nodes (n,), and the reason why the choice may be wrong: one line, empty if it is clear.

    `least_flux` is the flux that separates illuminated from dark.
    """

    nodes: NDArray[np.bool_]
    doubt: str
    least_flux: float


def find_illumination(spots: NodeFlux, lattice: Lattice, illuminated_fraction: float | None) -> Illumination:
    """Decide which nodes are illuminated.

    Parameters
    ----------
    spots : NodeLight
    lattice : Lattice
    illuminated_fraction : float, optional
        Smallest flux of an illuminated lenslet (exclusive), relative to the median flux of those found
        without it. Default: the value between 0.18 and 0.5 with the fewest lenslets near it, relative to the
        flux of a Gaussian beam if there is one: there, measurable spots are illuminated down to any flux.
    """
    found = _even_illumination(spots, lattice, illuminated_fraction)
    if illuminated_fraction is not None:
        return found
    for _ in range(_PASSES):
        profile = _beam_profile(spots, found.nodes, lattice)
        if profile is None:
            break
        clear, ratio = measurable(spots, spots, found.nodes), spots.signal_to_noise
        even = replace(
            spots,
            flux=spots.flux / profile,
            flux_noise=spots.flux_noise / profile,
            signal_to_noise=np.where(clear, np.maximum(ratio, _BRIGHT), ratio),
        )
        relative = _even_illumination(even, lattice, None)
        nodes = relative.nodes & (clear | found.nodes)
        if not nodes.any() or np.array_equal(nodes, found.nodes):
            return replace(found, doubt=relative.doubt)
        found = replace(found, nodes=nodes, doubt=relative.doubt)
    return found


def measurable(spots: SpotFlux, nodes: NodeFlux, illuminated: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which spots are measurable to 0.1 px, and have a shape like those of the illuminated nodes."""
    likeness = float(np.median(nodes.likeness[illuminated]))
    return np.asarray((spots.error_px < _MEASURABLE_PX) & (spots.likeness > LIKE * likeness))


def _beam_profile(
    spots: NodeFlux, illuminated: NDArray[np.bool_], lattice: Lattice
) -> NDArray[np.float64] | None:
    """Return the flux that a Gaussian beam has at each node, or None if the flux is not like that of one."""
    if np.count_nonzero(illuminated) < _FEWEST_FOR_BEAM:
        return None
    at = lattice.positions(spots.cells)
    at = (at - at[illuminated].mean()) / np.abs(at - at[illuminated].mean())[illuminated].max()
    x, y = at.real, at.imag
    terms = np.stack([np.ones(len(x)), x, y, x**2, x * y, y**2], axis=1)
    used, logs = terms[illuminated], np.log(np.maximum(spots.flux[illuminated], 1e-300))
    weights = np.ones(len(logs))
    for _ in range(_FITS):
        root = np.sqrt(weights)
        numbers = np.linalg.lstsq(root[:, None] * used, root * logs, rcond=None)[0]
        residual = logs - used @ numbers
        scale = max(MAD_TO_STD * float(np.median(np.abs(residual))), _LEAST_SCATTER)
        weights = np.maximum(1 - (residual / (_OUTLIER * scale)) ** 2, 0.0) ** 2
    spread = np.average((logs - np.average(logs, weights=weights)) ** 2, weights=weights)
    if np.average(residual**2, weights=weights) > (1 - _BEAM) * spread:
        return None
    curvature = np.array([[2 * numbers[3], numbers[4]], [numbers[4], 2 * numbers[5]]])
    if np.linalg.eigvalsh(curvature).max() > 0:
        return None
    return np.asarray(np.exp(terms @ numbers))


def _even_illumination(spots: NodeFlux, lattice: Lattice, illuminated_fraction: float | None) -> Illumination:
    """Decide which nodes of an evenly illuminated pupil are illuminated."""
    detected = _detection(spots)
    certain = detected > 1
    if not certain.any():
        return Illumination(certain, "", np.inf)
    choose = _Chooser(spots, detected, lattice)
    # Dim spots outside the pupil may be as many as those in it: start from the bright ones.
    bright = float(np.quantile(spots.flux[certain], 0.8))
    noise = float(np.median(spots.flux_noise[certain]))
    fraction = float(
        np.clip(_DETECTED * noise / bright, _emptiest(spots.flux[detected > 0] / bright), _FRACTIONS[1])
    )
    illuminated, reference, scatter = choose.settled(bright, fraction)
    if not _spans(spots.cells[illuminated]):
        # In one or two rows at the pupil's edge, the dimmer row must be illuminated: one row makes no sensor.
        fraction = _FRACTIONS[0]
        illuminated, reference, scatter = choose.settled(bright, fraction)
    if illuminated_fraction is not None:
        illuminated = choose.illuminated(reference, max(min(illuminated_fraction, fraction), 1e-6), scatter)
        illuminated &= spots.flux >= illuminated_fraction * reference
        fraction = illuminated_fraction
    return Illumination(
        illuminated,
        illumination_doubt(spots, illuminated, detected, fraction * reference),
        fraction * reference,
    )


@dataclass(frozen=True)
class _Chooser:
    """Selects the illuminated nodes from spots and the evidence for them."""

    spots: NodeFlux
    detected: NDArray[np.float64]
    lattice: Lattice

    def settled(self, reference: float, fraction: float) -> tuple[NDArray[np.bool_], float, float]:
        """Return the illuminated nodes, the median of their flux, and the scatter of its logarithm."""
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
        """Return the illuminated nodes for a dividing flux that is a fraction of the reference."""
        neighbours = self.lattice.neighbours(self.spots.cells)
        links = links_of(neighbours)
        relative = np.maximum(self.spots.flux / reference, 1e-6)
        noise = np.minimum(self.spots.flux_noise / reference / relative, 1.0)
        evidence = np.minimum(np.log(relative / fraction) / np.hypot(scatter, noise), self.detected)
        least = _least_cost(evidence, links, _NEIGHBOURS / neighbours.shape[1])
        return _connected(least, links, relative >= _TIP)


def _detection(spots: NodeFlux) -> NDArray[np.float64]:
    """Return the evidence for a spot at each node, from its significance and its position.

    Spots scatter about their nodes like the clear ones; noise peaks are uniform over the search area, and
    peaks of stray light are mostly at its rim.
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
    farthest = np.where(spots.signal_to_noise > _BRIGHT, _FARTHEST_BRIGHT, _FARTHEST)
    beyond = np.maximum((distance - farthest) / _RIM, 0.0)
    in_reach = np.where(beyond > 0, -beyond, _CLEAR)
    return np.asarray(np.minimum(ratio + np.clip(placed, -_PLACED, _PLACED), in_reach))


def _emptiest(relative: NDArray[np.float64]) -> float:
    """Return the fraction of the reference flux with the fewest nodes near it, in the allowed range."""
    fractions = np.geomspace(*_FRACTIONS, 13)
    # Near means within a factor of about 1.25, the scatter of equally illuminated lenslets.
    distance = np.log(np.maximum(relative[:, None], 1e-6) / fractions) / np.log(_CLOSE)
    crowd = np.exp(-0.5 * distance**2).sum(axis=0)
    # Among values with almost the same number of nodes, use the one nearest the middle of the range.
    crowded = np.round(crowd / max(_FEW * len(relative), 0.1))
    return float(fractions[np.lexsort((np.abs(np.arange(13) - 6), crowded))[0]])


def _spans(cells: NDArray[np.int64]) -> bool:
    """Return whether cells are in more than one row and column."""
    return len(cells) > 0 and bool(np.all(np.ptp(cells, axis=0) > 0))


def _log_scatter(flux: NDArray[np.float64]) -> float:
    """Return the robust standard deviation of the logarithm of the flux, limited to plausible values."""
    logs = np.log(np.maximum(flux, 1e-300))
    return float(np.clip(mad_std(logs), *_SCATTER))


def _least_cost(evidence: NDArray[np.float64], links: NDArray[np.int64], cost: float) -> NDArray[np.bool_]:
    """Return the illuminated set of least cost: contrary evidence, and links between illuminated and dark.

    It is the source side of the minimum cut; evidence for and against joins the nodes to source and sink.
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
    residual = graph - scipy.sparse.csgraph.maximum_flow(graph, source, sink).flow
    residual.data = np.maximum(residual.data, 0)
    residual.eliminate_zeros()
    reached = scipy.sparse.csgraph.breadth_first_order(residual, source, return_predecessors=False)
    result = np.zeros(count + 2, dtype=bool)
    result[reached] = True
    return result[:count]


def _connected(
    illuminated: NDArray[np.bool_], links: NDArray[np.int64], bright: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Return the illuminated nodes of the largest connected parts, without faint tips with one neighbour."""
    degree = np.bincount(links[illuminated[links].all(axis=1)].ravel(), minlength=len(illuminated))
    illuminated = illuminated & ((degree >= 2) | ((degree == 1) & bright))
    joined = links[illuminated[links].all(axis=1)]
    graph = scipy.sparse.coo_matrix(
        (np.ones(len(joined)), (joined[:, 0], joined[:, 1])), shape=(len(illuminated),) * 2
    )
    _, part = scipy.sparse.csgraph.connected_components(graph, directed=False)
    sizes = np.bincount(part[illuminated], minlength=part.max() + 1)
    return np.asarray(illuminated & (sizes >= max(2, _SHARE * sizes.max()))[part])


def illumination_doubt(
    spots: NodeFlux, illuminated: NDArray[np.bool_], detected: NDArray[np.float64], dividing_flux: float
) -> str:
    """Return the reason why the result may be wrong, in one line."""
    count = int(np.count_nonzero(illuminated))
    if count == 0:
        return ""
    flux = spots.flux[illuminated]
    ratio = float(np.median(spots.signal_to_noise[illuminated]))
    if ratio < FAINT:
        return f"the spots are only {ratio:.1f} standard deviations above the noise; average more frames"
    if (scatter := spots.scatter(illuminated)) > _SCATTERED:
        return (
            f"the spots lie {scatter:.2f} of the pitch from the lattice (median), as peaks anywhere would: "
            "its pitch or geometry may be wrong; give pitch_px"
        )
    close = (detected > 0) & (spots.flux < dividing_flux * _CLOSE) & (spots.flux > dividing_flux / _CLOSE)
    if np.count_nonzero(close) > max(3, _DOUBTFUL * count):
        return (
            f"{np.count_nonzero(close)} lenslets have about {dividing_flux / float(np.median(flux)):.2g} of "
            "the median flux, the limit between illuminated and dark, and may belong to either"
        )
    dim = int(np.count_nonzero(flux < 0.5 * np.quantile(flux, 0.8)))
    if dim > _DIM * count:
        return f"{dim} of the illuminated lenslets have less than half of the flux of the bright ones"
    return ""
