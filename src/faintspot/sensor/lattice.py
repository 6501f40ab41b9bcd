"""Which regular lattice the spots of a frame lie on, from the frame's power spectrum.

A lattice is kept as complex numbers: the node in row r and column c lies at
origin + step * (c + r * ratio), real part x, imaginary part y, in frame pixels; ratio is 1j for a square
lattice and exp(1j * pi / 3) for a hexagonal one. All positions have pixel i centred at i.

A regular lattice has one pitch and one angle only, so the search has two dimensions: at every wave number
and angle it looks at the weakest of the two (square) or three (hexagonal) first-order peaks. A stripe, an
edge or a gradient makes one of them strong, only a lattice makes all of them strong. This needs no spot to
be detected on its own.
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

from faintspot.sensor.neighbours import neighbours_of

RATIOS = {"square": 1j, "hexagonal": complex(np.exp(1j * np.pi / 3))}
# The lines of a hexagonal lattice are sqrt(3) / 2 of its pitch apart and its steps lie 30 degrees off.
_STEPS = {"square": 1 + 0j, "hexagonal": complex(2 / np.sqrt(3) * np.exp(1j * np.pi / 6))}
SMALLEST_PITCH_PX = 5.0
# Spot widths that are looked for: a spot up to twice as wide or narrow as one of these is seen by it.
_SCALES_PX = (1.0, 2.0, 4.0)
# A candidate must have at least this share of the highest significance of its map, and there are at most
# so many per map and geometry.
_CANDIDATE_SHARE = 0.1
_CANDIDATES = 3
# Minus the natural logarithm of the chance that noise alone makes one point of the map so high. It is low, as
# noise often passes it: it only spares time. What decides is the comb score, in standard deviations of the
# smoothed map (in 60 frames of noise, hot pixels or scattered spots it reached 5.3 once, else 4.5),
# and whether lit lenslets are found on the lattice.
_SIGNIFICANT = 6.0
_COMB_SCORE = 4.5
# With three times that, no other map of spots need be looked at: kin of the true lattice are in each of them.
_CLEAR_SCORE = 3 * _COMB_SCORE


@dataclass(frozen=True)
class Lattice:
    """A regular lattice of nodes: see the module's first lines.

    Parameters
    ----------
    geometry : str
        "square" or "hexagonal".
    origin : complex
        Position of one node, x + 1j * y, px.
    step : complex
        From a node to the next one in its row, px.
    """

    geometry: str
    origin: complex
    step: complex

    @property
    def ratio(self) -> complex:
        """The second lattice vector divided by the first."""
        return RATIOS[self.geometry]

    @property
    def pitch_px(self) -> float:
        """Distance between neighbouring nodes."""
        return abs(self.step)

    @property
    def angle_deg(self) -> float:
        """Angle of the step from +x towards +y."""
        return float(np.degrees(np.angle(self.step)))

    @property
    def wave(self) -> complex:
        """Wave vector of the first of the strongest peaks in the power spectrum, cycles per px."""
        return complex(1 / np.conj(self.step / _STEPS[self.geometry]))

    def positions(self, cells: NDArray[np.int64]) -> NDArray[np.complex128]:
        """Return where the nodes of the given (n, 2) rows and columns lie."""
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
        """Return the same lattice with its angle in [-45, 45) or [-30, 30) and its origin near mid-frame."""
        turn = 90.0 if self.geometry == "square" else 60.0
        angle = (self.angle_deg + turn / 2) % turn - turn / 2
        step = self.pitch_px * complex(np.exp(1j * np.radians(angle)))
        middle = complex(shape[1] / 2, shape[0] / 2)
        offset = (middle - self.origin) / step
        row = np.rint(offset.imag / self.ratio.imag)
        column = np.rint(offset.real - row * self.ratio.real)
        return replace(self, step=step, origin=self.origin + step * complex(column + row * self.ratio))

    def fitted(self, cells: NDArray[np.int64], positions: NDArray[np.complex128]) -> Lattice:
        """Return the lattice of least squared distance to spots (n,) x + 1j * y, those far off left out."""
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
        """Return the (n, 4 or 6) indices of the neighbours of every cell, n where there is none."""
        return neighbours_of(cells, self.geometry)

    def distance_px(self, y: NDArray[np.int64], x: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return how far from the node of its cell every pixel of these rows and columns lies: (y, x)."""
        offset = (x + 1j * y[:, None] - self.origin) / self.step
        offset -= np.rint(offset.imag / self.ratio.imag) * self.ratio
        return np.asarray(np.abs(offset - np.rint(offset.real)) * self.pitch_px)


def find_lattice(
    image: NDArray[np.float64], geometries: tuple[str, ...], pitch_range_px: tuple[float, float]
) -> tuple[Lattice, NDArray[np.float64]] | None:
    """Return the lattice that the spots of a frame lie on and the map of them, or None when there is none.

    Parameters
    ----------
    image : array (ny, nx)
        The frame without hot pixels.
    geometries : tuple of str
        The geometries to try.
    pitch_range_px : tuple of float
        The smallest and the largest pitch to try.
    """
    highest, best = _COMB_SCORE, None
    for spots in _spot_maps(image):
        found = _candidates(spots, geometries, pitch_range_px)
        if not found:
            continue
        # The same smoothing for all, about the size of the spots' own shifts, so that their scores compare.
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
    """Make maps of what looks like a spot, one per width, and one linear map for many very faint spots.

    The difference of two Gaussians takes the background away. What is left is taken above two standard
    deviations, so that empty parts of the frame add little noise, and its logarithm, so that dim spots count.
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
    """Return the standard deviation from the median absolute deviation; the plain one when that is 0."""
    deviation = 1.4826 * float(np.median(np.abs(values - np.median(values))))
    return deviation if deviation > 1e-9 * float(np.ptp(values)) else float(values.std())


def _candidates(
    spots: NDArray[np.float64], geometries: tuple[str, ...], pitch_range_px: tuple[float, float]
) -> list[Lattice]:
    """Return the lattices of the strongest peaks in the power spectrum of one map, and their coarser kin.

    The peaks of sharp spots are as strong in the higher orders as in the first, so that a peak may stand for
    a lattice that is 1.4 (square), 1.7 (hexagonal), 2, 2.8 or 3.5 times as coarse.
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
    """Return where the few highest peaks of the significance against wave number are."""
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

    Every row is divided by the mean power that its median stands for, so that noise has an exponential
    distribution of mean 1 whatever its spectrum.
    """
    size = int(scipy.fft.next_fast_len(2 * max(spots.shape), real=True))
    low, high = size / pitch_range_px[1], min(size / pitch_range_px[0] * 2 / np.sqrt(3), size / 2 - 2)
    radius = np.arange(low, max(high, low + 1), 0.5)
    # Only wave numbers up to the highest are wanted, which are few when the smallest pitch is many pixels.
    reach = int(np.ceil(radius[-1])) + 2
    rows = scipy.fft.rfft(np.asarray(spots - spots.mean(), dtype=np.float32), size)[:, : reach + 1]
    spectrum = scipy.fft.fft(rows, size, axis=0)
    half = np.abs(np.concatenate([spectrum[size - reach :], spectrum[: reach + 1]])) ** 2
    # A lattice that is stretched a little has its two peaks at not quite the same wave number.
    half = scipy.ndimage.maximum_filter(half, 3)
    # A multiple of 6 so that 60 and 90 degrees are whole numbers of columns.
    n_angles = 6 * int(np.ceil(np.pi * radius[-1] / 6))
    angle = np.pi * np.arange(n_angles) / n_angles
    kx, ky = radius[:, None] * np.cos(angle), radius[:, None] * np.sin(angle)
    mirrored = np.where(kx < 0, -1, 1)
    power = scipy.ndimage.map_coordinates(half, [ky * mirrored + reach, kx * mirrored], order=1)
    floor = np.median(power, axis=1, keepdims=True) / np.log(2)
    return power / np.maximum(floor, 1e-12 * float(power.max() + 1e-300)), radius / size


def _significance(power: NDArray[np.float64], geometry: str) -> NDArray[np.float64]:
    """Return minus the logarithm of the chance of the weakest first-order peak, per wave number and angle."""
    orders = 2 if geometry == "square" else 3
    turn = power.shape[1] // orders
    folded = power.reshape(power.shape[0], orders, turn)
    return np.asarray(orders * folded.min(axis=1))


def _refined(centred: NDArray[np.float64], geometry: str, wave: complex) -> complex:
    """Return the wave vector near `wave` at which the first-order peaks have the highest power together."""
    turns = _turns(geometry)
    y, x = (_tiles(n) for n in centred.shape)
    # Sums over tiles with the phase of `wave` taken out: a small move of the wave vector needs no more.
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
    """Return the directions of the first-order peaks, relative to the first of them."""
    ratio = RATIOS[geometry]
    return np.array([1, ratio] if geometry == "square" else [1, ratio, ratio**2])


@dataclass(frozen=True)
class _Tiles:
    """The pixels of one axis in groups: their positions from mid-frame, the groups' starts and centres."""

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
    """Return the sum over every tile of the image times exp(-2 pi i vector . position)."""
    y, x = (_tiles(n) for n in centred.shape)
    # Rows first, one real part at a time: the complex image is never made.
    phase_y = 2 * np.pi * y.pixels[:, None] * vector.imag
    rows = np.add.reduceat(centred * np.cos(phase_y), y.starts) - 1j * np.add.reduceat(
        centred * np.sin(phase_y), y.starts
    )
    return np.asarray(np.add.reduceat(rows * np.exp(-2j * np.pi * x.pixels * vector.real), x.starts, axis=1))


def _amplitude(centred: NDArray[np.float64], vector: complex) -> complex:
    """Return the sum of the image times exp(-2 pi i vector . position), position from mid-frame."""
    y, x = (2 * np.pi * (np.arange(n) - (n - 1) / 2) for n in centred.shape)
    columns = np.cos(y * vector.imag) @ centred - 1j * (np.sin(y * vector.imag) @ centred)
    return complex(np.sum(columns * np.exp(-1j * x * vector.real)))


def with_origin(centred: NDArray[np.float64], geometry: str, vector: complex) -> Lattice:
    """Return the lattice of a wave vector, with the origin that the phases of the first two peaks give."""
    waves = vector * _turns(geometry)[:2]
    phases = [-np.angle(_amplitude(centred, complex(wave))) / (2 * np.pi) for wave in waves]
    # At a node, wave . position is the phase (in turns) of either peak.
    position = np.linalg.solve(np.column_stack([waves.real, waves.imag]), phases)
    middle = complex((centred.shape[1] - 1) / 2, (centred.shape[0] - 1) / 2)
    step = _STEPS[geometry] / np.conj(vector)
    return Lattice(geometry, middle + complex(*position), complex(step)).canonical(centred.shape)


def _comb_score(smooth: NDArray[np.float64], lattice: Lattice) -> float:
    """Return the sum over the nodes divided by the root of their number.

    It is highest for the true lattice: one that misses every second spot has half the sum on half the nodes,
    one with a node between every two spots the same sum on twice the nodes.
    """
    at = lattice.positions(lattice.cells_inside(smooth.shape, 0.0))
    values = scipy.ndimage.map_coordinates(smooth, [at.imag, at.real], order=1, mode="nearest")
    return float(values.sum() / np.sqrt(max(len(values), 1)))
