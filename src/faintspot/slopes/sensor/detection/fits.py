"""Lattices fitted to the spots of a frame, and the choice of the one that explains them best."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from faintspot.slopes.sensor.background import least_difference, lenslet_background, values_at
from faintspot.slopes.sensor.detection.acquisition import follow
from faintspot.slopes.sensor.detection.candidates import Lattice, find_candidates
from faintspot.slopes.sensor.detection.illumination import (
    FAINT,
    LIKE,
    Illumination,
    find_illumination,
    measurable,
)
from faintspot.slopes.sensor.detection.nodes import (
    Drift,
    NodeFlux,
    SpotFlux,
    SpotImage,
    find_spots,
    inside_frame,
    levels_between,
    measure_nodes,
    no_drift,
    spot_width,
)
from faintspot.slopes.sensor.region import PupilRegion, as_rows, as_tree, links_of, neighbour_vectors

_FIT_PASSES = 10
# Refits, at most, without a background that ends at the edge of the pupil, and the quantiles between which
# that of dark lenslets spreads.
_REFITS, _DARK_SPREAD = 3, (0.1, 0.9)
# A spot with this signal-to-noise ratio that is as bright as those of illuminated lenslets and this far
# (pitches) from all of them belongs to another lenslet: a smooth aberration brings no two spots closer.
_CLEAR, _ELSEWHERE = 6.0, 0.4
# Displacements are followed if that reaches so many of these spots, or half of them (one may be a ghost), and
# the spots are this near (pitches, median) to their expected positions, unlike peaks within spots.
_REACHED, _FOLLOWED = 4, 0.15
# Spots farther than this from all illuminated nodes (in pitches) are not theirs, even if each lenslet has
# several; those nearer to the edge of the frame may belong to a lenslet outside.
_BETWEEN, _CUT = 0.45, 0.5
# Part of the spots and nodes that a lattice explains if others need not be tried, unless its score as a
# candidate is below this part of that of another, and below which there is a doubt; and part below which, of
# doubtful lattices, others with a lower score may be better.
_CERTAIN, _SUFFICIENT, _LITTLE = 0.85, 0.6, 0.4
# Median distance of the spots from their nodes (pitches) above which a fit to them makes a lattice worse.
_LOOSE = 0.18
# Bright spots at no node, at least so many and this part of the lenslets, that also raise a doubt; one does
# among so few lenslets.
_SPARE, _SPARE_PART, _FEW = 3, 0.02, 40
# Relative standard error of the pitch from which it is doubtful: jitter of 0.08 pitch in 4 x 4 lenslets stays
# below. That error takes displacements for independent, which those of a smooth aberration are not: the other
# limit is that of neighbours with such a correlation.
_LARGEST_ERROR, _ERROR, _ALIKE = 0.03, 0.012, 0.3
# Fewest lit lenslets, and fewest pairs of neighbouring spots in each direction: one pair is a coincidence.
FEWEST, _PAIRS = 4, 1.4
MOST = 4
"""Largest number of rows and columns that are searched for spot by spot."""
DIM = 0.4
"""Flux that a lenslet may have, relative to the median."""
_BEYOND = 0.25  # pitches outside the frame up to which a fit may move nodes into it


@dataclass(frozen=True)
class LatticeFit:
    """Lattice fitted to the spots, with measurements at its nodes and their illumination.

    `bright` are all spots as bright as the illuminated ones, `elsewhere` those of them at no
    illuminated node. `dim` are other measurable spots there.
    """

    lattice: Lattice
    width_px: float
    spots: NodeFlux
    illuminated: Illumination
    bright: NDArray[np.complex128]
    elsewhere: NDArray[np.complex128]
    dim: NDArray[np.complex128]
    shape: tuple[int, ...]
    few: bool = False
    """Whether it is an array of at most 4 x 4 lenslets that was found spot by spot."""

    @property
    def is_sensor(self) -> bool:
        """Whether there are lenslets enough for a sensor."""
        cells = self.spots.cells[self.illuminated.nodes]
        return self.few or (len(cells) >= FEWEST and bool(np.all(np.ptp(cells, axis=0) > 0)))

    @property
    def is_certain(self) -> bool:
        """Whether there is no doubt, nor so few lenslets that some may be hidden in the noise."""
        if not self.is_sensor or self.illuminated.doubt:
            return False
        lit = self.illuminated.nodes
        ratio, across = self.spots.signal_to_noise[lit], np.ptp(self.spots.cells[lit], axis=0) + 1
        return bool(across.max() > MOST or min(ratio.min(), DIM * np.median(ratio)) > FAINT)

    def is_better(self, few: LatticeFit) -> bool:
        """Whether this fit is to be used instead of one that was found spot by spot."""
        doubtful = bool(few.illuminated.doubt) or not self.illuminated.doubt
        return self.is_sensor and doubtful and self.lit > few.lit

    @property
    def lit(self) -> int:
        """Number of illuminated lenslets."""
        return int(np.count_nonzero(self.illuminated.nodes))

    @property
    def unexplained(self) -> tuple[int, int]:
        """Number of bright spots far from illuminated nodes, and of dark nodes enclosed by these."""
        lit = self.illuminated.nodes
        expected = (self.lattice.positions(self.spots.cells) + self.spots.drifts)[lit]
        inside = inside_frame(self.bright, self.shape, _CUT * self.lattice.pitch_px)
        distance = as_tree(expected).query(as_rows(self.bright[inside]))[0]
        far = int(np.count_nonzero(distance > _BETWEEN * self.lattice.pitch_px))
        cells = self.spots.cells[lit]
        dark = np.ones(np.ptp(cells, axis=0) + 3, dtype=bool)
        dark[tuple((cells - cells.min(axis=0) + 1).T)] = False
        joined = [[0, 1, 0], [1, 1, 1], [0, 1, 0]]
        if self.lattice.geometry == "hexagonal":
            joined = [[0, 1, 1], [1, 1, 1], [1, 1, 0]]
        sizes = np.bincount(scipy.ndimage.label(dark, joined)[0][dark])[2:]
        # The largest enclosed part may be the central obstruction.
        return far, int(sizes.sum() - sizes.max(initial=0))

    @property
    def displacements(self) -> tuple[float, float, float]:
        """Largest distance of a spot from its node, and standard error of the pitch, in pitches.

        The last number is the correlation of neighbours: 0 of jitter, up to 1 of a smooth aberration.
        """
        lit = self.illuminated.nodes
        cells = self.spots.cells[lit]
        nodes = self.lattice.positions(cells)
        off = self.spots.positions[lit] - nodes
        off -= off.mean()
        error = np.linalg.norm(off) / np.linalg.norm(nodes - nodes.mean()) / np.sqrt(max(len(off) - 2, 1))
        one, other = off[links_of(self.lattice.neighbours(cells)).T]
        squares = float(np.sum(np.abs(one) ** 2 + np.abs(other) ** 2))
        alike = 2 * float(np.vdot(one, other).real) / max(squares, 1e-300)
        return float(np.abs(off).max()) / self.lattice.pitch_px, float(error), alike

    @property
    def explained(self) -> float:
        """Agreement of lattice and spots, from 0 to 1: other spots and dark nodes speak against it."""
        count = np.count_nonzero(self.illuminated.nodes)
        return count / (count + sum(self.unexplained)) if count >= FEWEST else 0.0


def best_fit(
    image: NDArray[np.float64],
    geometries: tuple[str, ...],
    pitch_range_px: tuple[float, float],
    illuminated_fraction: float | None,
    pupil: PupilRegion | None,
) -> LatticeFit | None:
    """Return the fit of the candidate lattice that explains the spots best, or None without one."""
    if not np.ptp(image) > 0:
        return None
    image = image - np.median(image)
    best, highest, smoothed = None, -1.0, SpotImage(image)
    for score, lattice in find_candidates(image, geometries, pitch_range_px):
        nodes = len(lattice.cells_inside(image.shape, -_BEYOND * lattice.pitch_px))
        if score * nodes < _PAIRS or score <= _SUFFICIENT * highest:
            continue  # whatever its fit
        fit = _fitted(smoothed, lattice, illuminated_fraction, pupil)
        explained = fit.explained
        if explained > 0 and score * np.count_nonzero(fit.illuminated.nodes) < _PAIRS:
            continue
        if explained > _CERTAIN:
            best = fit
            break
        rank = score * min(1.0, explained / _LITTLE)
        if rank > highest:
            best, highest = fit, rank
    if best is None:
        return None
    for number in range(_REFITS):
        if (even := _without_background(image, best, in_steps=number == 0)) is None:
            break
        fit = _fitted(SpotImage(even), best.lattice, illuminated_fraction, pupil)
        if fit.lit < FEWEST:
            break
        best = fit
    if pupil is not None:
        held = pupil.holds(best.lattice.positions(best.spots.cells))
        beyond = best.spots.positions[best.illuminated.nodes & ~held]
        illuminated = replace(best.illuminated, nodes=held, doubt="")
        return replace(best, illuminated=illuminated, elsewhere=np.concatenate([best.elsewhere, beyond]))
    return replace(
        best, illuminated=replace(best.illuminated, doubt=_unclear(best) or best.illuminated.doubt)
    )


def _without_background(
    image: NDArray[np.float64], fit: LatticeFit, *, in_steps: bool
) -> NDArray[np.float64] | None:
    """Return an image without its background if that ends with the lit lenslets, otherwise None.

    Sky that is seen through lit lenslets only looks like the side of a spot at the edge of the pupil. It ends
    there if dark lenslets have more of the same background than of that of lit ones: haze goes on. Taking off
    the median of each cell, in steps, does not need to know the spots.
    """
    lattice, lit = fit.lattice, fit.illuminated.nodes
    at = lattice.positions(fit.spots.cells) + fit.spots.drifts
    beside = lattice.neighbours(fit.spots.cells)
    at_edge = np.append(~lit, False)[beside] & lit[:, None]
    if not at_edge.any():
        return None
    flux = float(np.median(fit.spots.flux[lit]))
    least = least_difference(image, flux, lattice.pitch_px, fit.width_px)

    def ends(levels: NDArray[np.float64]) -> bool:
        steps = levels[:, None] - np.append(levels, np.nan)[beside]
        spread = float(np.ptp(np.quantile(levels[~lit], _DARK_SPREAD)))
        return bool(np.median(steps[at_edge]) > max(least, spread))

    levels = levels_between(image, lattice, at)
    if not ends(levels):
        return None
    around = neighbour_vectors(lattice.geometry, lattice.pitch_px, lattice.angle_deg)
    background = lenslet_background(image, at[lit], around, lattice.pitch_px, fit.width_px)
    if not ends(values_at(background, at)):
        return None
    if in_steps:
        y, x = np.indices(image.shape)
        background = levels[as_tree(at).query(np.stack([x, y], axis=-1))[1]]
    return image - background


def _fitted(
    image: SpotImage, lattice: Lattice, illuminated_fraction: float | None, pupil: PupilRegion | None
) -> LatticeFit:
    """Fit the lattice to the spots; if some are left over, follow them from neighbour to neighbour."""
    width_px = spot_width(image, lattice)
    for _ in range(_FIT_PASSES):
        spots = measure_nodes(image, lattice, width_px)
        illuminated = find_illumination(spots, lattice, illuminated_fraction)
        used = illuminated.nodes
        if pupil is not None:
            used = used & pupil.holds(lattice.positions(spots.cells))
        if np.count_nonzero(used) < FEWEST or spots.scatter(used) > _LOOSE:
            break
        before = lattice
        lattice = lattice.fitted(spots.cells[used], spots.positions[used]).canonical(image.shape)
        if abs(lattice.step - before.step) * max(image.shape) < 0.02 * abs(lattice.step) ** 2:
            break
    if np.count_nonzero(used) < FEWEST:
        nothing = np.empty(0, dtype=np.complex128)
        return LatticeFit(lattice, width_px, spots, illuminated, nothing, nothing, nothing, image.shape)
    everywhere = find_spots(image, lattice, width_px)
    fit = _illuminated_of(image, lattice, width_px, illuminated_fraction, everywhere)
    for _ in range(_FIT_PASSES):
        if not 0 < len(fit.elsewhere) <= np.count_nonzero(fit.illuminated.nodes):
            break
        followed = follow(fit.bright, fit.lattice, image.shape)
        if followed is None:
            break
        better = _illuminated_of(image, followed[0], width_px, illuminated_fraction, everywhere, followed[1])
        reached = len(fit.elsewhere) - len(better.elsewhere)
        lit = better.illuminated.nodes
        near = lit.any() and np.median(np.abs(better.spots.shifts[lit])) < _FOLLOWED
        if not near or reached < max(1.0, min(_REACHED, 0.5 * len(fit.elsewhere))):
            break
        fit = better
    return fit


def _unclear(fit: LatticeFit) -> str:
    """Return a one-line warning if the lattice explains only a part of the spots or its pitch is unclear."""
    if fit.explained == 0:
        return ""
    elsewhere, dark = fit.unexplained
    count = fit.lit
    if fit.explained > _CERTAIN and elsewhere < (1 if count < _FEW else max(_SPARE, _SPARE_PART * count)):
        return pitch_doubt(fit)
    return (
        f"the lattice explains only a part of the flux: {elsewhere} bright spots belong to none of its "
        f"{count} lit lenslets, and {dark} dark ones lie between these; its pitch or geometry may be wrong, "
        "give one of them"
    )


def pitch_doubt(fit: LatticeFit) -> str:
    """Return a one-line warning if the spots are displaced too far to tell the pitch."""
    largest, error, alike = fit.displacements
    if error < (_ERROR if alike > _ALIKE else _LARGEST_ERROR):
        return ""
    return (
        f"spots lie up to {largest:.2f} of the pitch from the lattice, and {fit.lit} lit lenslets tell its "
        f"pitch to {error:.1%} only; give pitch_px if it is known"
    )


def _illuminated_of(
    image: SpotImage,
    lattice: Lattice,
    width_px: float,
    illuminated_fraction: float | None,
    everywhere: SpotFlux,
    drift: Drift = no_drift,
) -> LatticeFit:
    """Decide which lenslets of a lattice are illuminated, and which bright spots belong to none of them."""
    spots = measure_nodes(image, lattice, width_px, drift)
    illuminated = find_illumination(spots, lattice, illuminated_fraction)
    elsewhere = bright = dim = np.empty(0, dtype=np.complex128)
    lit = illuminated.nodes
    if lit.any():
        is_bright = _bright(everywhere, spots, illuminated)
        clear = is_bright | measurable(everywhere, spots, lit)
        dark = spots.positions[~lit & measurable(spots, spots, lit)]
        reach_px = _ELSEWHERE * lattice.pitch_px
        bright, taken = everywhere.positions[is_bright], spots.positions[lit]
        elsewhere = _away(bright, taken, reach_px)
        dark = _away(dark, everywhere.positions[clear], reach_px)
        dim = _away(np.append(everywhere.positions[clear & ~is_bright], dark), taken, reach_px)
    return LatticeFit(lattice, width_px, spots, illuminated, bright, elsewhere, dim, image.shape)


def _away(
    at: NDArray[np.complex128], others: NDArray[np.complex128], reach_px: float
) -> NDArray[np.complex128]:
    """Return the positions that are farther than this from all others."""
    return np.asarray(at[as_tree(others).query(as_rows(at))[0] > reach_px])


def _bright(everywhere: SpotFlux, spots: NodeFlux, illuminated: Illumination) -> NDArray[np.bool_]:
    """Return which spots are as bright as those of illuminated lenslets, and of similar shape."""
    ratio, likeness = (
        float(np.median(values[illuminated.nodes])) for values in (spots.signal_to_noise, spots.likeness)
    )
    # In the cells of a lattice that is too coarse, other spots count as noise.
    clear = everywhere.signal_to_noise > min(_CLEAR, 0.5 * ratio)
    alike = everywhere.likeness > LIKE * likeness
    return np.asarray(clear & alike & (everywhere.flux >= illuminated.least_flux))
