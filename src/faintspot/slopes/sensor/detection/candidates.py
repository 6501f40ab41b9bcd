"""Candidate lattices of the spots of a frame, from the autocorrelation of maps of spots.

The autocorrelation of an array of spots is high at the vectors of its lattice, highest at the shortest: a
lag of two pitches has fewer pairs of spots than a lag of one, and a lag of half a pitch has none. The search
evaluates the lowest of the two (square) or three (hexagonal) shortest vectors at each pitch and angle. A
stripe, an edge or a gradient makes one of them high, but only a lattice makes all of them high. Single spots
need not be detectable.

Spots may be a pixel wide or as wide as a quarter of the pitch, and be displaced by a tenth of it. The maps
are therefore made from images of half the resolution again and again, and reduced until the pitch is 8 to 16
pixels.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from faintspot.base.statistics import mad_std
from faintspot.slopes.sensor.region import neighbours_of

RATIOS = {"square": 1j, "hexagonal": complex(np.exp(1j * np.pi / 3))}
SMALLEST_PITCH_PX = 5.0


@dataclass(frozen=True)
class Lattice:
    """Regular lattice of nodes, with positions as defined in the module docstring.

    Parameters
    ----------
    geometry : str
        Geometry, "square" or "hexagonal".
    origin : complex
        Position of one node, x + 1j * y, px.
    step : complex
        Vector from a node to the next one in its row [px].
    """

    geometry: str
    origin: complex
    step: complex

    @property
    def ratio(self) -> complex:
        """Ratio of the second lattice vector to the first."""
        return RATIOS[self.geometry]

    @property
    def pitch_px(self) -> float:
        """Distance between neighbouring nodes [px]."""
        return abs(self.step)

    @property
    def angle_deg(self) -> float:
        """Angle of the step from +x towards +y [degrees]."""
        return float(np.degrees(np.angle(self.step)))

    def positions(self, cells: NDArray[np.int64]) -> NDArray[np.complex128]:
        """Return the positions of the nodes in the given (n, 2) rows and columns."""
        return self.origin + self.step * (cells[:, 1] + cells[:, 0] * self.ratio)

    def cells_inside(self, shape: tuple[int, ...], margin_px: float) -> NDArray[np.int64]:
        """Return (n, 2) rows and columns of the nodes at least `margin_px` inside a frame of this shape."""
        height, width = shape
        low = margin_px - 0.5
        corners = np.array([0, width - 1, 1j * (height - 1), width - 1 + 1j * (height - 1)])
        offset = (corners - self.origin) / self.step
        rows = offset.imag / self.ratio.imag
        columns = offset.real - rows * self.ratio.real
        row, column = (
            np.arange(int(np.floor(axis.min())) - 1, int(np.ceil(axis.max())) + 2) for axis in (rows, columns)
        )
        at = self.origin + self.step * (column + row[:, None] * self.ratio)
        inside = (
            (at.real >= low) & (at.real <= width - 1 - low) & (at.imag >= low) & (at.imag <= height - 1 - low)
        )
        return np.asarray(np.argwhere(inside) + np.array([row[0], column[0]]))

    def canonical(self, shape: tuple[int, ...]) -> Lattice:
        """Return the same lattice with angle in [-45, 45) or [-30, 30) and origin near the frame centre."""
        turn = 90.0 if self.geometry == "square" else 60.0
        angle = (self.angle_deg + turn / 2) % turn - turn / 2
        step = self.pitch_px * complex(np.exp(1j * np.radians(angle)))
        middle = complex(shape[1] / 2, shape[0] / 2)
        offset = (middle - self.origin) / step
        row = np.rint(offset.imag / self.ratio.imag)
        column = np.rint(offset.real - row * self.ratio.real)
        return replace(self, step=step, origin=self.origin + step * complex(column + row * self.ratio))

    def fitted(self, cells: NDArray[np.int64], positions: NDArray[np.complex128]) -> Lattice:
        """Return the least-squares fit of the lattice to spots (n,) x + 1j * y, with outliers removed."""
        nodes = cells[:, 1] + cells[:, 0] * self.ratio
        used = np.ones(len(nodes), dtype=bool)
        for _ in range(3):
            columns = np.column_stack([np.ones(used.sum()), nodes[used]])
            (origin, step), *_ = np.linalg.lstsq(columns, positions[used], rcond=None)
            distance = np.abs(positions - origin - step * nodes)
            # 1.1774 sigma is the median distance of a two-dimensional normal distribution.
            used = distance <= max(3.5 * float(np.median(distance)) / 1.1774, 0.5)
        return replace(self, origin=complex(origin), step=complex(step))

    def neighbours(self, cells: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the (n, 4 or 6) indices of the neighbours of each cell, n where there is none."""
        return neighbours_of(cells, self.geometry)

    def distance_px(self, y: NDArray[np.int64], x: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the distance of every pixel (y, x) from the node of its cell."""
        offset = (x + 1j * y[:, None] - self.origin) / self.step
        offset -= np.rint(offset.imag / self.ratio.imag) * self.ratio
        return np.asarray(np.abs(offset - np.rint(offset.real)) * self.pitch_px)


def robust_std(values: NDArray[Any]) -> float:
    """Return the standard deviation from the median absolute deviation; the ordinary one if that is 0."""
    deviation = mad_std(values)
    return deviation if deviation > 1e-9 * float(np.ptp(values)) else float(values.std())


# Pitches searched for in one map, in its pixels.
_OCTAVE = (6.0, 16.0)
_ANGLES = 120  # per half turn: less than half a pixel apart at the largest pitch
# Noise of a map relative to its brightest spots: below, the wings of spots would be as high as their peaks.
_NOISE_FLOOR = 0.01
# Lowest score of a candidate, in standard deviations of the autocorrelation, and maximum number of
# candidates per map and geometry, and of all.
_SIGNIFICANT, _PER_MAP, _MOST = 3.0, 8, 12
# Of scores from this part of the highest on, that of the finest lattice counts as highest. One with dark
# nodes has less: a lattice that is finer by a factor of 1.4 has half.
_EQUAL = 0.85
# The refined pitch may be outside the range by this factor.
_TOLERANCE = 1.03
# Lattices are the same if their steps differ by less than this part.
_SAME = 0.06


def find_candidates(
    image: NDArray[np.float64], geometries: tuple[str, ...], pitch_range_px: tuple[float, float]
) -> list[tuple[float, Lattice]]:
    """Return scores and lattices that the spots of a frame may have, the most likely first.

    Parameters
    ----------
    image : array (ny, nx)
        Frame without hot pixels.
    geometries : tuple of str
        Geometries to try.
    pitch_range_px : tuple of float
        Smallest and largest pitch to try.
    """
    scored: list[tuple[float, Lattice]] = []
    for spots, factor in _maps(image, pitch_range_px[1]):
        scored += _of_map(spots, factor, geometries, pitch_range_px)
    scored.sort(key=lambda pair: -pair[0])
    kept: list[tuple[float, Lattice]] = []
    for score, lattice in scored:
        lattice = lattice.canonical(image.shape)
        if not any(_same(lattice, other) for _, other in kept):
            kept.append((score, lattice))
    best = kept[0][0] if kept else 0.0
    # A coarser lattice of the same spots has almost the same score in a large array.
    return sorted(kept[:_MOST], key=lambda pair: pair[1].pitch_px if pair[0] > _EQUAL * best else np.inf)


def _same(one: Lattice, other: Lattice) -> bool:
    """Return whether two lattices in canonical form are about the same, except for their origins."""
    if one.geometry != other.geometry:
        return False
    turn = one.ratio ** np.arange(-1, 2)
    return bool(np.abs(one.step * turn - other.step).min() < _SAME * other.pitch_px)


def _maps(image: NDArray[np.float64], largest_pitch_px: float) -> Iterator[tuple[NDArray[np.float32], int]]:
    """Yield maps of spots and their binning: of spots from sharp to broad, each from fine to coarse."""
    level, factor = image, 1
    while factor == 1 or _OCTAVE[0] * factor <= largest_pitch_px:
        spots, total = _spot_map(level), factor
        while spots is not None and (total == 1 or _OCTAVE[0] * total <= largest_pitch_px):
            yield spots, total
            spots, total = _binned(spots), 2 * total
        level, factor = _binned(level), 2 * factor


def _binned(image: NDArray[np.generic]) -> NDArray[Any]:
    """Return the mean of 2 x 2 pixels; an odd last row or column is left out."""
    ny, nx = image.shape[0] // 2, image.shape[1] // 2
    return np.asarray(image[: 2 * ny, : 2 * nx].reshape(ny, 2, nx, 2).mean(axis=(1, 3)))


def _spot_map(image: NDArray[np.float64]) -> NDArray[np.float32] | None:
    """Return a map of features about a pixel wide, or None if there are none.

    The difference of two Gaussians removes the background. Noise is not cut off, so that many spots below it
    add up; bright values are compressed, so that dim spots contribute.
    """
    band = scipy.ndimage.gaussian_filter(image, 1.0) - scipy.ndimage.gaussian_filter(image, 4.0)
    noise = max(robust_std(band), _NOISE_FLOOR * float(np.quantile(band, 0.999)))
    if not noise > 0:
        return None
    spots = np.arcsinh(np.maximum(band / noise, -2.0))
    return spots.astype(np.float32) if np.ptp(spots) > 0 else None


def _of_map(
    spots: NDArray[np.float32], factor: int, geometries: tuple[str, ...], pitch_range_px: tuple[float, float]
) -> list[tuple[float, Lattice]]:
    """Return the scores and lattices of the highest peaks of one map."""
    low, high = pitch_range_px[0] / factor, pitch_range_px[1] / factor
    if factor > 1:
        low = max(low, _OCTAVE[0])
    high = min(high, _OCTAVE[1])
    if low >= high:
        return []
    # Without the mean over a few pitches, the autocorrelation between the spots is 0 or less.
    spots = spots - scipy.ndimage.gaussian_filter(spots, 0.5 * high)
    correlation = _autocorrelation(spots)
    noise = robust_std(correlation)
    radius = np.arange(0.9 * low, 1.1 * high + 0.25, 0.25)
    angle = np.pi * np.arange(_ANGLES) / _ANGLES
    reach = int(radius[-1]) + 4
    near = np.roll(correlation, (reach, reach), axis=(0, 1))[: 2 * reach + 1, : 2 * reach + 1]
    lags = radius[:, None] * np.exp(1j * angle)
    polar = scipy.ndimage.map_coordinates(near, [lags.imag + reach, lags.real + reach])
    found = []
    for geometry in geometries:
        orders = 2 if geometry == "square" else 3
        score = polar.reshape(len(radius), orders, -1).min(axis=1)
        for row, column in _peaks(score, _SIGNIFICANT * noise):
            step = _refined(correlation, geometry, complex(radius[row] * np.exp(1j * angle[column])))
            if low / _TOLERANCE <= abs(step) <= high * _TOLERANCE:
                found.append((float(score[row, column]), _with_origin(spots, geometry, step, factor)))
    return found


def _autocorrelation(spots: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the autocorrelation relative to that at lag 0, negative lags at the end of each axis."""
    size = [int(scipy.fft.next_fast_len(2 * n, real=True)) for n in spots.shape]
    power = np.abs(scipy.fft.rfft2(spots, size)) ** 2
    correlation = scipy.fft.irfft2(power, size)
    return np.asarray(correlation / correlation[0, 0])


def _peaks(score: NDArray[np.float32], least: float) -> list[tuple[int, int]]:
    """Return the indices (radius, angle) of the few highest peaks; angles wrap around."""
    highest = scipy.ndimage.maximum_filter(score, (7, 7), mode=("nearest", "wrap"))
    rows, columns = np.nonzero((score == highest)[1:-1] & (score[1:-1] > least))
    order = np.argsort(-score[rows + 1, columns])[:_PER_MAP]
    return [(int(row) + 1, int(column)) for row, column in zip(rows[order], columns[order], strict=True)]


def _refined(correlation: NDArray[np.float32], geometry: str, step: complex) -> complex:
    """Return the step from the peaks at 1, 2, 4 ... times the shortest vectors of the lattice."""
    turns = RATIOS[geometry] ** np.arange(2 if geometry == "square" else 3)
    times = 1
    while times == 1 or times * abs(step) < min(correlation.shape) / 6:
        lags = times * step * turns
        step = complex(
            np.mean([_peak_near(correlation, complex(lag), 0.25 * abs(step)) for lag in lags] / turns)
        )
        step, times = step / times, 2 * times
    return step


def _peak_near(correlation: NDArray[np.float32], lag: complex, reach_px: float) -> complex:
    """Return the lag of the highest value near a lag, by a parabola through it and its neighbours."""
    reach = max(1, int(reach_px))
    y = np.arange(round(lag.imag) - reach - 1, round(lag.imag) + reach + 2)
    x = np.arange(round(lag.real) - reach - 1, round(lag.real) + reach + 2)
    values = correlation[np.ix_(y % correlation.shape[0], x % correlation.shape[1])]
    row, column = np.unravel_index(values[1:-1, 1:-1].argmax(), (len(y) - 2, len(x) - 2))
    cross = values[row : row + 3, column : column + 3]
    return complex(x[column + 1] + _top(cross[1]), y[row + 1] + _top(cross[:, 1]))


def _top(three: NDArray[np.float32]) -> float:
    """Return the place of the maximum of a parabola through values at -1, 0 and 1."""
    bend = float(three[0] - 2 * three[1] + three[2])
    return float(np.clip(0.5 * (three[0] - three[2]) / bend, -0.5, 0.5)) if bend < 0 else 0.0


def _with_origin(spots: NDArray[np.float32], geometry: str, step: complex, factor: int) -> Lattice:
    """Return the lattice in pixels of the frame, with the origin at which its nodes have most of the map."""
    # Wave vectors whose phase is the same at all nodes. At a node, it is that of the map's peak.
    ratio = RATIOS[geometry]
    basis = np.array([[step.real, step.imag], [(step * ratio).real, (step * ratio).imag]])
    waves = np.linalg.inv(basis).T @ [1, 1j]
    phases = [np.angle(_amplitude(spots, complex(wave))) / (2 * np.pi) for wave in waves]
    middle = complex(spots.shape[1] - 1, spots.shape[0] - 1) / 2
    node = middle + step * (phases[0] + phases[1] * ratio)
    return Lattice(geometry, factor * (node + 0.5 + 0.5j) - 0.5 - 0.5j, factor * step)


def _amplitude(spots: NDArray[np.float32], wave: complex) -> complex:
    """Return the sum of a map times exp(2 pi i wave . position), position from the middle of the map."""
    y, x = (2 * np.pi * (np.arange(n) - (n - 1) / 2) for n in spots.shape)
    return complex(np.exp(1j * y * wave.imag) @ spots @ np.exp(1j * x * wave.real))
