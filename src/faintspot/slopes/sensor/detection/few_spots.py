"""Arrays of 1 x 1 to 4 x 4 lenslets: lattices through pairs of the brightest spots of a frame.

So few spots hardly show in an autocorrelation, but each stands out of the noise by itself. Spots of any
width are the peaks of differences of Gaussians. Each pair of spots gives a lattice; the best one has most of
the spots in a rectangle of nodes of which few are empty. All widths compete by the same score, so that
neither speckles nor the blur of all spots are taken for lenslets.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from faintspot.base.statistics import FWHM_TO_STD, MAD_TO_STD
from faintspot.slopes.sensor.detection.candidates import RATIOS, Lattice, robust_std
from faintspot.slopes.sensor.detection.fits import DIM, FEWEST, MOST, LatticeFit, pitch_doubt
from faintspot.slopes.sensor.detection.illumination import FAINT, Illumination, illumination_doubt
from faintspot.slopes.sensor.detection.nodes import SpotImage, inside_frame, measure_nodes, spot_width
from faintspot.slopes.sensor.region import as_rows, as_tree

# Widths of the spots searched for: from the first [px], by this factor, to this part of the frame.
_SHARPEST_PX, _STEP, _BROADEST = 0.7, 1.4, 0.2
_MOST_PX = 2.5  # width [px] from which on pixels are binned
# Noise of a difference of Gaussians whose second is twice as wide, times the width [px], in white noise of 1.
_WHITE = float(np.sqrt(0.45 / (4 * np.pi)))
_MOST_FOR_PLANE = 50_000  # pixels
_TILE_PX = 16  # side of the parts of the image whose noise is measured
_NOISE_FLOOR = 1e-3  # of the highest peak
# Significance of peaks, and from which on one without a node counts; largest number of peaks.
_SEEN, _CLEAR, _MOST_PEAKS = 4.0, 5.5, 24
# Flux relative to the brightest peak, and to the median of the lenslets, from which on a spot is a lenslet's;
# significance of one beside the others.
_BRIGHT, _LIT, _BESIDE = 0.25, 0.2, 4.5
# Significance above `_NONE` up to `_CAP` is evidence; an empty node costs this part of that of a bright spot.
_NONE, _CAP, _EMPTY = 4.0, 6.0, 0.9
_PAIR = 0.875  # of the evidence of two spots, through which there always is a lattice
_APART = 3.5  # least pitch, in widths
_NEAR = 0.3  # pitches from a node
_LOOSE = 0.15  # pitches from a node that spots of an incomplete array do not reach
_NEXT = 1.6  # pitches within which nodes are beside each other
# Clear spots beside so few; part of the brightest from which on one counts beside a lattice.
_MOST_OTHERS, _GHOST = 6, 0.1
_ALIKE = 0.4  # of the brightest peak: more such peaks than lenslets are those of a larger array
_SIMILAR = 0.65  # part of the width of a single spot from which on another one may be of its array
_ANGLE_DEG, _PITCH = 8.0, 1.2  # tolerances of what is stated
_SINGLE = 5.0  # pitch of a single spot, in its FWHM
_NOISY = 0.007  # relative error of the pitch
_QUARTERS = 0.5  # FWHM in pitches from which on four spots may be parts of one


@dataclass(frozen=True)
class Stated:
    """Known properties of the array; None: not known."""

    geometries: tuple[str, ...]
    pitch_px: float | None = None
    angle_deg: float | None = None
    grid: tuple[int, int] | None = None


@dataclass(frozen=True)
class _Peaks:
    """Peaks (n,) of one width: positions, significance and height, the most significant first."""

    width_px: float
    at: NDArray[np.complex128]
    ratio: NDArray[np.float64]
    height: NDArray[np.float64]

    @property
    def evidence(self) -> NDArray[np.float64]:
        return np.minimum(self.ratio - _NONE, _CAP) + 1e-4 * np.minimum(self.ratio, 1e3)

    @property
    def bright(self) -> NDArray[np.bool_]:
        return np.asarray(self.height > _BRIGHT * self.height[0])


@dataclass(frozen=True)
class _Match:
    """Rectangle of nodes of a lattice, with its score."""

    score: float
    lattice: Lattice
    nodes: NDArray[np.complex128]
    peaks: _Peaks


def few_spots(image: NDArray[np.float64], stated: Stated) -> LatticeFit | None:
    """Return the fit of an array of at most 4 x 4 lenslets that has the bright spots, or None without one."""
    image = _flattened(image)
    levels = list(_levels(image))
    best: _Match | None = None
    for peaks in levels:
        match = _best_match(peaks, stated)
        if match is not None and (best is None or match.score > best.score):
            best = match
    return None if best is None else _fitted(SpotImage(image), best, levels, stated)


def _flattened(image: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the image without the plane that fits what is not bright."""
    every = max(1, int(np.sqrt(image.size / _MOST_FOR_PLANE)))
    sample = image[::every, ::every]
    middle, scatter = np.median(sample), robust_std(sample)
    y, x = every * np.indices(sample.shape).reshape(2, -1)
    values = np.clip(sample.ravel(), middle - 3 * scatter, middle + 3 * scatter)
    level, down, right = np.linalg.lstsq(np.column_stack([np.ones(len(x)), y, x]), values)[0]
    plane = level + down * np.arange(image.shape[0])[:, None] + right * np.arange(image.shape[1])
    return np.asarray(image - plane)


def _levels(image: NDArray[np.float64]) -> Iterator[_Peaks]:
    """Yield the peaks of each width, from sharp to broad."""
    factor, width_px, level, noise = 1, _SHARPEST_PX, image, _noise(image)
    while width_px < _BROADEST * min(image.shape):
        if width_px > _MOST_PX * factor:
            ny, nx = level.shape[0] // 2, level.shape[1] // 2
            level = level[: 2 * ny, : 2 * nx].reshape(ny, 2, nx, 2).mean(axis=(1, 3))
            factor *= 2
            noise = _noise(level)
        width = width_px / factor
        narrow, wide = (scipy.ndimage.gaussian_filter(level, k * width, mode="nearest") for k in (1, 2))
        band = narrow - wide
        least = np.maximum(noise * _WHITE / width, max(_NOISE_FLOOR * float(band.max()), 1e-300))
        side = 2 * int(np.ceil(1.5 * width)) + 1
        y, x = np.nonzero((band == scipy.ndimage.maximum_filter(band, side)) & (band > _SEEN * least))
        order = np.argsort(-band[y, x], kind="stable")
        y, x = y[order], x[order]
        at = factor * (x + 1j * y + 0.5 + 0.5j) - 0.5 - 0.5j
        if len(at):
            yield _Peaks(width_px, np.asarray(at, np.complex128), (band / least)[y, x], band[y, x])
        width_px *= _STEP


def _noise(image: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the standard deviation of white noise around each pixel: photon noise follows the background."""
    rough = np.abs(np.diff(image, 2, axis=1, append=image[:, -3:-1]))
    height, width = image.shape
    rows, columns = np.arange(0, height, _TILE_PX), np.arange(0, width, _TILE_PX)
    tiles = np.array(
        [[np.median(rough[y : y + 2 * _TILE_PX, x : x + 2 * _TILE_PX]) for x in columns] for y in rows]
    )
    tiles = scipy.ndimage.median_filter(tiles, 3, mode="nearest") * MAD_TO_STD / np.sqrt(6)
    return np.asarray(tiles.repeat(_TILE_PX, axis=0).repeat(_TILE_PX, axis=1)[:height, :width])


def _best_match(peaks: _Peaks, stated: Stated) -> _Match | None:
    """Return the rectangle of nodes with the highest score: spots less empty nodes and spots elsewhere."""
    at = peaks.at[:_MOST_PEAKS]
    clear = peaks.bright & (peaks.ratio > _CLEAR)
    elsewhere = float(peaks.evidence[clear].sum())  # costs as much as it would be worth at nodes
    worth = np.where(peaks.bright, peaks.evidence * (1.0 + clear), 0.0)[:_MOST_PEAKS]
    best: _Match | None = None
    if stated.grid in (None, (1, 1)):
        side = _SINGLE * peaks.width_px / FWHM_TO_STD
        lattice = Lattice("square", complex(at[0]), complex(side))
        best = _Match(float(worth[0]) - elsewhere, lattice, at[:1], peaks)
    for geometry in stated.geometries:
        ratio = RATIOS[geometry]
        origin, step = _through_pairs(at, geometry, _APART * peaks.width_px, stated)
        if not len(step):
            continue
        away = (at - origin[:, None]) / step[:, None]
        row = np.rint(away.imag / ratio.imag)
        column = np.rint(away.real - row * ratio.real)
        off = np.abs(away - column - row * ratio) / _NEAR
        pair, spot = np.nonzero((off < 1) & (np.maximum(np.abs(row), np.abs(column)) < MOST))
        place = pair, row[pair, spot].astype(int) + MOST - 1, column[pair, spot].astype(int) + MOST - 1
        table = np.zeros((len(step), 2 * MOST - 1, 2 * MOST - 1))
        np.maximum.at(table, place, worth[spot] * (1 - off[pair, spot] ** 2))
        table = np.where(table > 0, table, -_EMPTY * peaks.evidence[0])
        sums = np.pad(table, ((0, 0), (1, 0), (1, 0))).cumsum(axis=1).cumsum(axis=2)
        for (top, bottom), (left, right) in _rectangles(stated.grid):
            part = 1.0 if (bottom - top) * (right - left) > 2 else _PAIR
            score = part * (
                sums[:, bottom, right] - sums[:, top, right] - sums[:, bottom, left] + sums[:, top, left]
            )
            index = int(np.argmax(score))
            if best is None or score[index] - elsewhere > best.score:
                rows, columns = np.mgrid[top:bottom, left:right].reshape(2, -1) - MOST + 1
                lattice = Lattice(geometry, complex(origin[index]), complex(step[index]))
                nodes = lattice.positions(np.column_stack([rows, columns]))
                best = _Match(float(score[index]) - elsewhere, lattice, nodes, peaks)
    return best


def _through_pairs(
    at: NDArray[np.complex128], geometry: str, least_px: float, stated: Stated
) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Return origins and steps of the lattices that have two spots up to three nodes apart in a row."""
    first, second = np.triu_indices(len(at), 1)
    times, quarter = np.arange(1, MOST)[:, None], 90.0 if geometry == "square" else 60.0
    step = ((at[second] - at[first]) / times).ravel()
    step *= np.exp(-1j * np.radians(quarter * np.rint(np.degrees(np.angle(step)) / quarter)))
    used = np.abs(step) > least_px
    if stated.pitch_px is not None:
        used &= np.abs(np.log(np.maximum(np.abs(step), 1e-9) / stated.pitch_px)) < np.log(_PITCH)
    if stated.angle_deg is not None:
        turn = (np.degrees(np.angle(step)) - stated.angle_deg + quarter / 2) % quarter - quarter / 2
        used &= np.abs(turn) < _ANGLE_DEG
    return np.tile(at[first], MOST - 1)[used], step[used]


def _rectangles(grid: tuple[int, int] | None) -> Iterator[tuple[tuple[int, int], tuple[int, int]]]:
    """Yield the first row and column, and those behind the last, of rectangles that contain the origin."""
    ends = [(a, b) for a in range(MOST) for b in range(MOST, 2 * MOST) if b - a <= MOST]
    for rows in ends:
        for columns in ends:
            size = (rows[1] - rows[0], columns[1] - columns[0])
            if size != (1, 1) and (grid is None or size in (grid, grid[::-1])):
                yield rows, columns


def _fitted(image: SpotImage, match: _Match, levels: list[_Peaks], stated: Stated) -> LatticeFit | None:
    """Measure the spots of a rectangle and fit the lattice to them; None if it is part of a larger array."""
    single, width_px = len(match.nodes) == 1, match.peaks.width_px
    reach_px, least = (
        (0.6 * match.lattice.pitch_px, _GHOST) if len(match.nodes) >= FEWEST else (4 * width_px, 0.0)
    )
    finer = [peaks for peaks in levels if peaks.width_px <= width_px]
    others = max((_others(peaks, match.nodes, reach_px, least) for peaks in finer), key=len)
    alike = max(
        np.count_nonzero(peaks.ratio[peaks.height > _ALIKE * peaks.height[0]] > _CLEAR) for peaks in finer
    )
    if stated.grid is None and (len(others) > max(_MOST_OTHERS, len(match.nodes)) or alike > MOST**2):
        return None
    fit = _measured(image, match, stated)
    if fit is None:
        return None
    lit, spots = fit.illuminated.nodes, fit.spots
    at, size = spots.positions[lit], np.ptp(spots.cells[lit], axis=0) + 1
    elsewhere = _others(match.peaks, at, reach_px, _BRIGHT)
    if stated.grid is None:
        loose = np.abs(spots.shifts[lit]).max() > _LOOSE and (len(elsewhere) or len(at) < size.prod())
        if loose or len(elsewhere) >= len(at):
            return None  # any spots have such a lattice
    fit = replace(fit, bright=np.append(at, elsewhere), elsewhere=elsewhere, dim=others)
    similar = [peaks.bright.sum() for peaks in finer if peaks.width_px > _SIMILAR * width_px]
    hides = single and (max(similar) > 1 or DIM * spots.signal_to_noise[lit].max() < _SEEN)
    doubt = _doubt(fit, size, stated, hides=hides)
    return replace(fit, illuminated=replace(fit.illuminated, doubt=doubt))


def _measured(image: SpotImage, match: _Match, stated: Stated) -> LatticeFit | None:
    """Fit the lattice to the spots of a rectangle, and of nodes beside it where the array is not stated."""
    lattice, nodes, single = match.lattice, match.nodes, len(match.nodes) == 1
    for last in (False, False, False, True):
        lattice = lattice.canonical(image.shape)
        nodes = nodes[inside_frame(nodes, image.shape, 0.0)]
        if not len(nodes):
            return None
        width_px = spot_width(image, lattice, nodes)
        spots = measure_nodes(image, lattice, width_px)
        away = as_tree(nodes).query(as_rows(lattice.positions(spots.cells)))[0] / lattice.pitch_px
        lit = (away < 0.5) & (spots.signal_to_noise > _NONE)
        if not lit.any():
            return None
        least = _LIT * float(np.median(spots.flux[lit]))
        if stated.grid is None and not single:
            lit |= (away < _NEXT) & (spots.signal_to_noise > _BESIDE) & (np.abs(spots.shifts) < _NEAR)
        lit &= spots.flux > least
        cells, at = spots.cells[lit], spots.positions[lit]
        size = np.ptp(cells, axis=0) + 1
        if size.max() > MOST or len(cells) < min(2, len(match.nodes)):
            return None
        if last:
            break
        if single:
            edge = np.array(image.shape[::-1]) - 1 - as_rows(at)[0]
            inside = 2 * float(np.minimum(as_rows(at)[0], edge).min()) + 1
            side = min(_SINGLE * width_px / FWHM_TO_STD, inside)
            lattice, nodes = replace(lattice, origin=complex(at[0]), step=complex(max(side, 3.0))), at
        else:
            lattice = lattice.fitted(cells, at)
        if stated.grid is None and not single:
            nodes = lattice.positions(np.argwhere(np.ones(size, bool)) + cells.min(axis=0))
    if len(at) < FEWEST and spots.signal_to_noise[lit].min() < FAINT:
        return None  # noise has so many peaks
    nothing, illuminated = np.empty(0, np.complex128), Illumination(lit, "", least)
    return LatticeFit(lattice, width_px, spots, illuminated, nothing, nothing, nothing, image.shape, few=True)


def _others(
    peaks: _Peaks, spots: NDArray[np.complex128], reach_px: float, least: float
) -> NDArray[np.complex128]:
    """Return the clear peaks farther than this from all spots, of at least this part of the highest one."""
    at = peaks.at[(peaks.ratio > _CLEAR) & (peaks.height > least * peaks.height[0])]
    return np.asarray(at[as_tree(spots).query(as_rows(at))[0] > reach_px])


def _doubt(fit: LatticeFit, size: NDArray[np.int64], stated: Stated, *, hides: bool) -> str:
    """Return why the array may be another one, in one line; empty if it is clear."""
    spots, lit, array = fit.spots, fit.illuminated.nodes, f"{size[0]} x {size[1]}"
    known, empty = stated.grid is not None, size.prod() - fit.lit
    ratio, fwhm = spots.signal_to_noise[lit], fit.width_px / FWHM_TO_STD / fit.lattice.pitch_px
    doubts = []
    if len(fit.elsewhere):
        doubts.append(
            f"{len(fit.elsewhere)} bright spots belong to none of the {fit.lit} lenslets of an array of "
            f"{array}; --grid ROWSxCOLUMNS states the array, --roi leaves them out"
        )
    elif not known and (empty > 1 or 1 < fit.lit < FEWEST):
        doubts.append(
            f"{fit.lit} spots may be {array} lenslets or a part of more; --grid ROWSxCOLUMNS states it"
        )
    elif not known and tuple(size) == (2, 2) and fwhm > _QUARTERS and abs(fit.lattice.angle_deg) < _ANGLE_DEG:
        doubts.append(
            "such wide spots may be the parts of one on a quad cell; --grid 2x2 or 1x1 states the array"
        )
    if hides or min(ratio.min(), DIM * np.median(ratio) if empty else np.inf) < FAINT:
        doubts.append(f"{fit.lit} spots stand out, others may be hidden in the noise; average more frames")
    if stated.pitch_px is None and fit.lit > 1:
        nodes = fit.lattice.positions(spots.cells[lit])
        noise = np.sqrt(np.mean(spots.error_px[lit] ** 2)) / np.linalg.norm(nodes - nodes.mean())
        if fit.lit == 2 or noise > _NOISY:
            doubts.append(
                f"{fit.lit} lenslets tell their pitch to {noise:.1%} at best; average more frames, or give "
                "pitch_px"
            )
        elif not doubts and (doubt := pitch_doubt(fit)):
            doubts.append(doubt)
    return "; ".join(doubts) or illumination_doubt(
        spots, lit, spots.signal_to_noise - _NONE, fit.illuminated.least_flux
    )
