"""Regular lattice of the spots of a frame, found in the frame's power spectrum.

A lattice is stored as complex numbers: the node in row r and column c is at origin + step * (c + r *
ratio), with real part x and imaginary part y in frame pixels; ratio is 1j for a square lattice and exp(1j *
pi / 3) for a hexagonal one. In all positions, pixel i is centred at i.

A regular lattice has one pitch and one angle, so that the search has two dimensions. The search evaluates
the weakest of the two (square) or three (hexagonal) first-order peaks at each wave number and angle. A
stripe, an edge or a gradient makes one of them strong, but only a lattice makes all of them strong. Single
spots need not be detectable.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.fft
import scipy.ndimage
import scipy.optimize
from numpy.typing import NDArray

from faintspot.slopes.sensor.neighbours import neighbours_of

RATIOS = {"square": 1j, "hexagonal": complex(np.exp(1j * np.pi / 3))}
# The lines of a hexagonal lattice are sqrt(3) / 2 of its pitch apart, and rotated by 30 degrees from its
# steps.
_STEPS = {"square": 1 + 0j, "hexagonal": complex(2 / np.sqrt(3) * np.exp(1j * np.pi / 6))}
SMALLEST_PITCH_PX = 5.0
# Spot widths searched for: each also detects spots up to twice as wide or narrow.
_SCALES_PX = (1.0, 2.0, 4.0)
# Minimum significance of a candidate relative to the highest of its map, and maximum number of candidates per
# map and geometry.
_CANDIDATE_SHARE = 0.1
_CANDIDATES = 3
# Minus the natural logarithm of the probability that noise alone gives such a high point of the map. The
# limit is low and only saves time; noise often exceeds it. The decision is by the comb score, in standard
# deviations of the smoothed map (in 60 frames of noise, hot pixels or scattered spots it reached 5.3 once,
# otherwise 4.5), and by whether illuminated lenslets are found on the lattice.
_SIGNIFICANT = 6.0
_COMB_SCORE = 4.5
# Above three times that score, other maps of spots are skipped: relatives of the true lattice are in all
# maps.
_CLEAR_SCORE = 3 * _COMB_SCORE


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

    @property
    def wave(self) -> complex:
        """Wave vector of the first of the strongest peaks in the power spectrum [cycles per px]."""
        return complex(1 / np.conj(self.step / _STEPS[self.geometry]))

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


def find_lattice(
    image: NDArray[np.float64], geometries: tuple[str, ...], pitch_range_px: tuple[float, float]
) -> tuple[Lattice, NDArray[np.float64]] | None:
    """Return the lattice of the spots of a frame and the map of spots, or None if there is none.

    Parameters
    ----------
    image : array (ny, nx)
        Frame without hot pixels.
    geometries : tuple of str
        Geometries to try.
    pitch_range_px : tuple of float
        Smallest and largest pitch to try.
    """
    highest, best = _COMB_SCORE, None
    for spots in _spot_maps(image):
        found = _candidates(spots, geometries, pitch_range_px)
        if not found:
            continue
        # Equal smoothing, about the displacements of the spots, makes the scores comparable.
        smooth_px = 0.08 * min(lattice.pitch_px for lattice in found)
        smooth = scipy.ndimage.gaussian_filter(spots - spots.mean(), smooth_px)
        scatter = float(smooth.std())
        for lattice in found:
            score = _comb_score(smooth, lattice) / scatter
            if score > highest:
                highest, best = score, (lattice, spots)
        if highest > _CLEAR_SCORE:
            break
    return best


def _spot_maps(image: NDArray[np.float64]) -> Iterator[NDArray[np.float64]]:
    """Yield maps of spot-like features, one per width, and one linear map for many very faint spots.

    The difference of two Gaussians removes the background. The map is thresholded at two standard
    deviations, so that empty parts of the frame add little noise; its logarithm is used, so that dim spots
    contribute.
    """
    for scale in _SCALES_PX:
        band = scipy.ndimage.gaussian_filter(image, scale) - scipy.ndimage.gaussian_filter(image, 4 * scale)
        noise = robust_std(band)
        if noise > 0:
            spots = np.log1p(np.maximum(band / noise - 2.0, 0.0))
            if np.ptp(spots) > 0:
                yield spots
            if scale == 1.0:
                yield np.clip(band / noise, -5.0, 5.0)


def robust_std(values: NDArray[np.float64]) -> float:
    """Return the standard deviation from the median absolute deviation; the ordinary one if that is 0."""
    deviation = 1.4826 * float(np.median(np.abs(values - np.median(values))))
    return deviation if deviation > 1e-9 * float(np.ptp(values)) else float(values.std())


def _candidates(
    spots: NDArray[np.float64], geometries: tuple[str, ...], pitch_range_px: tuple[float, float]
) -> list[Lattice]:
    """Return the lattices of the strongest peaks in the power spectrum of one map, and related coarser ones.

    For sharp spots, higher orders are as strong as the first, so that a peak may belong to a lattice 1.4
    (square), 1.7 (hexagonal), 2, 2.8 or 3.5 times as coarse.
    """
    power, wave_numbers = _polar_power(spots, pitch_range_px)
    centred = spots - spots.mean()
    maps = {geometry: _significance(power, geometry) for geometry in geometries}
    threshold = max(_SIGNIFICANT, _CANDIDATE_SHARE * max(float(values.max()) for values in maps.values()))
    found = []
    for geometry, significance in maps.items():
        for peak in _peaks(significance.max(axis=1), threshold):
            angle = np.pi * int(significance[peak].argmax()) / power.shape[1]
            wave = complex(wave_numbers[peak] * np.exp(1j * angle))
            wave = _refined(centred, geometry, wave)
            for kin in (1.0, 1 + RATIOS[geometry], 2.0, 2 * (1 + RATIOS[geometry])):
                pitch = abs(kin / wave) / RATIOS[geometry].imag
                if pitch_range_px[0] <= pitch <= pitch_range_px[1]:
                    found.append(with_origin(centred, geometry, wave / kin))
    return found


def _peaks(profile: NDArray[np.float64], threshold: float) -> list[int]:
    """Return the indices of the few highest peaks of significance against wave number."""
    peaks = np.flatnonzero((profile >= scipy.ndimage.maximum_filter1d(profile, 7)) & (profile > threshold))
    kept: list[int] = []
    for peak in peaks[np.argsort(-profile[peaks])]:
        if all(abs(int(peak) - other) > 3 for other in kept) and len(kept) < _CANDIDATES:
            kept.append(int(peak))
    return kept


def _polar_power(
    spots: NDArray[np.float64], pitch_range_px: tuple[float, float]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the power at wave numbers (rows, cycles per px) and angles from 0 to 180 degrees (columns).

    Each row is divided by the mean power implied by its median, so that noise has an exponential
    distribution of mean 1 for any spectrum.
    """
    size = int(scipy.fft.next_fast_len(2 * max(spots.shape), real=True))
    low, high = size / pitch_range_px[1], min(size / pitch_range_px[0] * 2 / np.sqrt(3), size / 2 - 2)
    radius = np.arange(low, max(high, low + 1), 0.5)
    # Only wave numbers up to the highest are needed, which are few if the smallest pitch is many pixels.
    reach = int(np.ceil(radius[-1])) + 2
    rows = scipy.fft.rfft(np.asarray(spots - spots.mean(), dtype=np.float32), size)[:, : reach + 1]
    spectrum = scipy.fft.fft(rows, size, axis=0)
    half = np.abs(np.concatenate([spectrum[size - reach :], spectrum[: reach + 1]])) ** 2
    # A slightly stretched lattice has its two peaks at slightly different wave numbers.
    half = scipy.ndimage.maximum_filter(half, 3)
    # A multiple of 6, so that 60 and 90 degrees are whole numbers of columns.
    n_angles = 6 * int(np.ceil(np.pi * radius[-1] / 6))
    angle = np.pi * np.arange(n_angles) / n_angles
    kx, ky = radius[:, None] * np.cos(angle), radius[:, None] * np.sin(angle)
    mirrored = np.where(kx < 0, -1, 1)
    power = scipy.ndimage.map_coordinates(half, [ky * mirrored + reach, kx * mirrored], order=1)
    floor = np.median(power, axis=1, keepdims=True) / np.log(2)
    return power / np.maximum(floor, 1e-12 * float(power.max() + 1e-300)), radius / size


def _significance(power: NDArray[np.float64], geometry: str) -> NDArray[np.float64]:
    """Return minus the log probability of the weakest first-order peak, per wave number and angle."""
    orders = 2 if geometry == "square" else 3
    turn = power.shape[1] // orders
    folded = power.reshape(power.shape[0], orders, turn)
    return np.asarray(orders * folded.min(axis=1))


def _refined(centred: NDArray[np.float64], geometry: str, wave: complex) -> complex:
    """Return the wave vector near `wave` with the highest total power of the first-order peaks."""
    turns = _turns(geometry)
    y, x = (_tiles(n) for n in centred.shape)
    # Sums over tiles with the phase of `wave` removed are sufficient for a small change of the wave vector.
    sums = [_tile_sums(centred, wave * turn) for turn in turns]
    unit = 0.25 / max(centred.shape)

    def loss(move: NDArray[np.float64]) -> float:
        moved = complex(*move) * unit * turns
        amplitudes = [
            np.exp(-2j * np.pi * y.centres * vector.imag)
            @ total
            @ np.exp(-2j * np.pi * x.centres * vector.real)
            for total, vector in zip(sums, moved, strict=True)
        ]
        return -float(np.sum(np.abs(amplitudes) ** 2))

    start = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    options = {"initial_simplex": start, "xatol": 0.02, "fatol": np.inf, "maxfev": 80}
    fit = scipy.optimize.minimize(loss, [0.0, 0.0], method="Nelder-Mead", options=options)
    return complex(wave + complex(*fit.x) * unit)


def _turns(geometry: str) -> NDArray[np.complex128]:
    """Return the directions of the first-order peaks relative to the first one."""
    ratio = RATIOS[geometry]
    return np.array([1, ratio] if geometry == "square" else [1, ratio, ratio**2])


@dataclass(frozen=True)
class _Tiles:
    """Pixels of one axis in groups: positions from the frame centre, and starts and centres of the groups."""

    pixels: NDArray[np.floating[Any]]
    starts: NDArray[np.int64]
    centres: NDArray[np.floating[Any]]


def _tiles(n_pixels: int) -> _Tiles:
    """Return at most 64 groups of the pixels of one axis."""
    pixels = np.arange(n_pixels) - (n_pixels - 1) / 2
    size = -(-n_pixels // 64)
    starts = np.arange(0, n_pixels, size)
    centres = np.add.reduceat(pixels, starts) / np.diff(np.append(starts, n_pixels))
    return _Tiles(pixels.astype(np.float64), starts, centres)


def _tile_sums(centred: NDArray[np.float64], vector: complex) -> NDArray[np.complex128]:
    """Return the sum over each tile of the image times exp(-2 pi i vector . position)."""
    y, x = (_tiles(n) for n in centred.shape)
    # Rows first, real and imaginary parts separately, to avoid a complex image.
    phase_y = 2 * np.pi * y.pixels[:, None] * vector.imag
    rows = np.add.reduceat(centred * np.cos(phase_y), y.starts) - 1j * np.add.reduceat(
        centred * np.sin(phase_y), y.starts
    )
    return np.asarray(np.add.reduceat(rows * np.exp(-2j * np.pi * x.pixels * vector.real), x.starts, axis=1))


def _amplitude(centred: NDArray[np.float64], vector: complex) -> complex:
    """Return the sum of the image times exp(-2 pi i vector . position), position from the frame centre."""
    y, x = (2 * np.pi * (np.arange(n) - (n - 1) / 2) for n in centred.shape)
    columns = np.cos(y * vector.imag) @ centred - 1j * (np.sin(y * vector.imag) @ centred)
    return complex(np.sum(columns * np.exp(-1j * x * vector.real)))


def with_origin(centred: NDArray[np.float64], geometry: str, vector: complex) -> Lattice:
    """Return the lattice of a wave vector, with the origin given by the phases of the first two peaks."""
    waves = vector * _turns(geometry)[:2]
    phases = [-np.angle(_amplitude(centred, complex(wave))) / (2 * np.pi) for wave in waves]
    # At a node, wave . position is the phase (in turns) of each peak.
    position = np.linalg.solve(np.column_stack([waves.real, waves.imag]), phases)
    middle = complex((centred.shape[1] - 1) / 2, (centred.shape[0] - 1) / 2)
    step = _STEPS[geometry] / np.conj(vector)
    return Lattice(geometry, middle + complex(*position), complex(step)).canonical(centred.shape)


def _comb_score(smooth: NDArray[np.float64], lattice: Lattice) -> float:
    """Return the sum over the nodes divided by the square root of their number.

    It is highest for the true lattice: a lattice of every second spot has half the sum on half the nodes,
    and one with an additional node between spots the same sum on twice the nodes.
    """
    at = lattice.positions(lattice.cells_inside(smooth.shape, 0.0))
    values = scipy.ndimage.map_coordinates(smooth, [at.imag, at.real], order=1, mode="nearest")
    return float(values.sum() / np.sqrt(max(len(values), 1)))
