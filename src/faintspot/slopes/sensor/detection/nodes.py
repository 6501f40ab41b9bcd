"""Spots at the nodes of a lattice: positions, fluxes and significance.

The flux of a spot is measured above a plane fitted together with it to the pixels of its cell, and its
noise is that of the same pixels. Haze, gradients and surrounding spots are therefore not taken for spots,
and noise in one part of the frame does not hide spots in another.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import scipy
from numpy.typing import NDArray

from faintspot.slopes.sensor.detection.candidates import Lattice, robust_std

# Search radius around a node, in pitches: it includes aberrations of +-15 % of the pitch per axis and an
# error of the first lattice fit, but not the spots of neighbours.
SEARCH = 0.35
# A node closer to the edge of the frame (in pitches) has its spot cut.
_MARGIN = 0.12
# Smallest distance between spots searched for anywhere, along x or y; spots of nodes outside the frame are
# followed up to `REACH`. Both in pitches.
_APART, REACH = 0.3, 1.5
# A spot and its plane are fitted to pixels within this distance, in pitches: slightly beyond half-way to the
# neighbour, so that a plane is distinguished from the top of a broad spot.
_CELL = 0.55
# Significance (standard deviations) above which peaks are used to measure the width of the spots.
_CERTAIN = 4.0
# Spot widths (standard deviation) to try: from the sharpest that pixels sample to a blur that fills the cell,
# in steps of 1.25. Peaks are taken from three of them, about a factor of 2.5 apart: a filter that is 1.6
# times too wide or narrow keeps 0.9 of the signal-to-noise ratio.
_SHARPEST_PX, _BROADEST = 0.6, 0.25
_WIDTHS, _STARTS = 9, (1, 4, 7)
_RUNG = 1.25  # ratio of the widths of these filters, the same for all lattices
# Width from which on boxes stand for a Gaussian, and their number; smoothed images that are kept.
_WIDE_PX, _BOXES, _MOST_KEPT = 8.0, 3, 16
_MOST_FOR_WIDTH = 500  # spots; their width is then known far more precisely than needed
_MOST_FOR_NOISE = 50_000  # pixels; the robust deviation of so many is known to 1 %

Drift = Callable[[NDArray[np.complex128]], NDArray[np.complex128]]


def no_drift(nodes: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Return displacements of zero, for spots expected at their nodes."""
    return np.zeros_like(nodes)


@dataclass(frozen=True, eq=False)
class SpotImage:
    """Pixels (ny, nx), and how they look smoothed: computed once for all lattices that are tried.

    Parameters
    ----------
    pixels : array (ny, nx)
    """

    pixels: NDArray[np.float64]
    _known: dict[tuple[str, float], NDArray[np.float64]] = field(default_factory=dict)

    @property
    def shape(self) -> tuple[int, ...]:
        """Height and width."""
        return self.pixels.shape

    def haze(self, pitch_px: float) -> NDArray[np.float64]:
        """Return the mean over a pitch around each pixel, to which regular spots contribute evenly."""
        side = round(pitch_px)
        return self._once("haze", side, lambda: _box(_box(self.pixels, side, "nearest"), 3, "nearest"))

    def smooth(self, width_px: float) -> NDArray[np.float64]:
        """Return the image under a Gaussian, or one made of boxes if that is wide.

        It is dark outside the frame: a mirrored spot would shift the peak to the edge.
        """
        return self._once("smooth", width_px, lambda: _smooth(self.pixels, width_px))

    def _once(
        self, kind: str, size: float, compute: Callable[[], NDArray[np.float64]]
    ) -> NDArray[np.float64]:
        """Return what was computed for this size, among the last few."""
        if (kind, size) not in self._known:
            while len(self._known) >= _MOST_KEPT:
                del self._known[next(iter(self._known))]
            self._known[kind, size] = compute()
        return self._known[kind, size]

    def band(self, lattice: Lattice, width_px: float) -> NDArray[np.float64]:
        """Return the smoothed image without the haze around the spots."""
        return np.asarray(self.smooth(width_px) - self.haze(lattice.pitch_px))


def _box(image: NDArray[np.float64], side: int, mode: str) -> NDArray[np.float64]:
    return np.asarray(scipy.ndimage.uniform_filter(image, side, mode=mode))


def _smooth(image: NDArray[np.float64], width_px: float) -> NDArray[np.float64]:
    """Smooth by a Gaussian, or by boxes whose variances have the same sum (Kovesi 2010, Proc. DICTA, 345)."""
    if width_px < _WIDE_PX:
        return np.asarray(scipy.ndimage.gaussian_filter(image, width_px, mode="constant", truncate=3.0))
    side = int((np.sqrt(4 * width_px**2 + 1) - 1) / 2) * 2 + 1
    narrow = round((12 * width_px**2 - _BOXES * (side + 1) * (side + 3)) / (-4 * side - 4))
    for index in range(_BOXES):
        image = _box(image, side if index < narrow else side + 2, "constant")
    return image


@dataclass(frozen=True)
class SpotFlux:
    """Positions, fluxes and significance of spots, each array (n,).

    Parameters
    ----------
    positions : complex array
        Positions of the peaks, x + 1j * y [px].
    flux, flux_noise : arrays
        Flux above the local plane within 2.5 standard deviations of the spot shape (at most half a pitch),
        and its noise.
    signal_to_noise : array
        Signal-to-noise ratio of the fitted spot, relative to the noise of its own cell.
    likeness : array
        Fraction of the squared flux explained by the spot shape: small for cosmic rays and hot pixels.
    error_px : array
        Standard error of the position along an axis: that of a Gaussian in the noise of its own cell.
    """

    positions: NDArray[np.complex128]
    flux: NDArray[np.float64]
    flux_noise: NDArray[np.float64]
    signal_to_noise: NDArray[np.float64]
    likeness: NDArray[np.float64]
    error_px: NDArray[np.float64]


@dataclass(frozen=True)
class NodeFlux(SpotFlux):
    """The brightest spot near each node of a lattice, each array (n,).

    Parameters
    ----------
    cells : int array (n, 2)
    drifts : complex array
        Vectors from the nodes to the expected positions of the spots [px].
    shifts : complex array
        Vectors from these positions to the peaks, in pitches.
    """

    cells: NDArray[np.int64]
    drifts: NDArray[np.complex128]
    shifts: NDArray[np.complex128]

    def scatter(self, chosen: NDArray[np.bool_]) -> float:
        """Return the median distance of the chosen spots from their common displacement, in pitches."""
        shifts = self.shifts[chosen]
        middle = np.median(shifts.real) + 1j * np.median(shifts.imag)
        return float(np.median(np.abs(shifts - middle)))


def measure_nodes(image: SpotImage, lattice: Lattice, width_px: float, drift: Drift = no_drift) -> NodeFlux:
    """Measure the spot of each node whose spot is expected inside the frame.

    Parameters
    ----------
    image : SpotImage
    lattice : Lattice
    width_px : float
        Standard deviation of the spot shape.
    drift : function
        Function that returns the expected displacements [px] of the spots of nodes at x + 1j * y.
    """
    band = image.band(lattice, width_px)
    margin_px = _MARGIN * lattice.pitch_px
    cells = lattice.cells_inside(image.shape, margin_px if drift is no_drift else -REACH * lattice.pitch_px)
    drifts = drift(lattice.positions(cells))
    at = lattice.positions(cells) + drifts
    inside = inside_frame(at, image.shape, margin_px - 0.5)
    cells, drifts, at = cells[inside], drifts[inside], at[inside]
    peaks, _ = _peaks(band, lattice, at)
    spots = _measured(image, band, lattice, width_px, peaks)
    return NodeFlux(**vars(spots), cells=cells, drifts=drifts, shifts=(peaks - at) / lattice.pitch_px)


def find_spots(image: SpotImage, lattice: Lattice, width_px: float) -> SpotFlux:
    """Measure all peaks of a frame that are clearly spots, at any position."""
    band = image.band(lattice, width_px)
    side = 2 * max(1, int(_APART * lattice.pitch_px)) + 1
    high = (band == scipy.ndimage.maximum_filter(band, side)) & (band > _CERTAIN * _noise(band, lattice))
    y, x = np.nonzero(high)
    return _measured(image, band, lattice, width_px, x + 1j * y)


def levels_between(
    image: NDArray[np.float64], lattice: Lattice, at: NDArray[np.complex128]
) -> NDArray[np.float64]:
    """Return the median (n,) of the pixels around each node that are nearer to it than to its neighbours."""
    offsets = _disc(max(0.5 * lattice.pitch_px, 2.0))
    values = _around(image, at, offsets[np.abs(offsets) > SEARCH * lattice.pitch_px])
    values[np.isnan(values).all(axis=1)] = 0.0
    return np.asarray(np.nanmedian(values, axis=1))


def inside_frame(at: NDArray[np.complex128], shape: tuple[int, ...], margin_px: float) -> NDArray[np.bool_]:
    """Return which positions are at least a margin inside the centres of the outermost pixels of a frame."""
    x, y = at.real, at.imag
    inside = (np.minimum(x, y) >= margin_px) & (x <= shape[1] - 1 - margin_px)
    return np.asarray(inside & (y <= shape[0] - 1 - margin_px))


def _measured(
    image: SpotImage,
    band: NDArray[np.float64],
    lattice: Lattice,
    width_px: float,
    peaks: NDArray[np.complex128],
) -> SpotFlux:
    """Fit a spot and a plane to the pixels around each peak."""
    offsets = _cell_offsets(lattice)
    values = _around(image.pixels, peaks, offsets)
    inside = ~np.isnan(values)
    values = np.where(inside, values, 0.0)
    model = _model(offsets, lattice, width_px)
    numbers, inverse = _fits(values, inside, model)
    spot = model[:, 3]
    residual = np.where(inside, values - numbers @ model.T, 0.0)
    # Use the noise of the background: for bright spots, residuals are dominated by the shape of the spot.
    weight = (1 - spot) ** 2
    least = (1e-9 * float(np.ptp(image.pixels))) ** 2
    white = np.maximum((residual**2 @ weight) / np.maximum(inside @ weight, 1e-12), least)
    variance = white + _coloured(image.pixels, band, lattice, width_px)
    near = np.abs(offsets) <= max(1.5, min(2.5 * width_px, 0.5 * lattice.pitch_px))
    fitted = (numbers[:, 3:] * spot)[:, near]
    flux = (residual[:, near] + fitted).sum(axis=1)
    explained = (fitted**2).sum(axis=1)
    height = np.maximum(numbers[:, 3], 1e-30)
    slopes = numbers[:, 1:3] / lattice.pitch_px + _leaning(residual, offsets, spot)
    return SpotFlux(
        peaks + _subpixel(image.smooth(width_px), peaks, slopes),
        flux,
        np.sqrt(variance * np.count_nonzero(near)),
        numbers[:, 3] / np.sqrt(variance * inverse[:, 3, 3]),
        explained / np.maximum(explained + (residual[:, near] ** 2).sum(axis=1), 1e-300),
        width_px * np.sqrt(2 * white * inverse[:, 3, 3]) / height,
    )


def _leaning(
    residual: NDArray[np.float64], offsets: NDArray[np.complex128], spot: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return by how much planes lean (n, 2) that were fitted as if spots were in the middles of pixels."""
    along = np.stack([offsets.real, offsets.imag])
    across = along * (1 - spot * (along**2 @ spot / (along**2 @ spot**2))[:, None])
    return np.asarray(residual @ across.T / (along * across).sum(axis=1))


def spot_width(image: SpotImage, lattice: Lattice, nodes: NDArray[np.complex128] | None = None) -> float:
    """Return the standard deviation [px] of the Gaussian that is most similar to the spots.

    It has the highest total signal-to-noise ratio of the fits, over all spots, or over those of these nodes.
    """
    widest = max(1.2, _BROADEST * lattice.pitch_px)
    widths = np.geomspace(_SHARPEST_PX, widest, _WIDTHS)
    every, at = nodes is None, nodes
    if at is None:
        at = lattice.positions(lattice.cells_inside(image.shape, _MARGIN * lattice.pitch_px))
    offsets = _cell_offsets(lattice)
    best = (-np.inf, float(widths[0]))
    for start in _STARTS:
        start_px = _SHARPEST_PX * _RUNG ** round(np.log(widths[start] / _SHARPEST_PX) / np.log(_RUNG))
        band = image.band(lattice, start_px)
        peaks, heights = _peaks(band, lattice, at)
        certain = np.flatnonzero(heights >= _CERTAIN * _noise(band, lattice)) if every else np.arange(len(at))
        if every and len(certain) < 4:
            continue
        chosen = certain[:: -(-len(certain) // _MOST_FOR_WIDTH)]
        values = _around(image.pixels, peaks[chosen], offsets)
        inside = ~np.isnan(values)
        for width in widths:
            numbers, inverse = _fits(np.where(inside, values, 0.0), inside, _model(offsets, lattice, width))
            ratio = numbers[:, 3] / np.sqrt(inverse[:, 3, 3])
            # The sum also rewards a width that makes more spots significant; it is clipped for cosmic rays.
            score = float(np.minimum(ratio, 3 * np.median(ratio)).mean()) * len(certain)
            best = max(best, (score, float(width)))
    return best[1]


def _disc(radius_px: float) -> NDArray[np.complex128]:
    """Return the whole-pixel offsets within a radius, x + 1j * y."""
    reach = int(radius_px)
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    offsets = (x + 1j * y).ravel()
    return np.asarray(offsets[np.abs(offsets) <= radius_px])


def _cell_offsets(lattice: Lattice) -> NDArray[np.complex128]:
    return _disc(max(_CELL * lattice.pitch_px, 2.9))


def _around(
    image: NDArray[np.float64], at: NDArray[np.complex128], offsets: NDArray[np.complex128]
) -> NDArray[np.float64]:
    """Return the pixels (n, m) at m offsets from the pixels nearest to n positions, NaN outside the frame."""
    reach = int(np.max(np.abs(offsets.real)))
    padded = np.pad(image, reach + 1, constant_values=np.nan)
    stride = padded.shape[1]
    first = (np.rint(at.imag).astype(np.int64) + reach + 1) * stride + np.rint(at.real).astype(np.int64)
    steps = offsets.imag.astype(np.int64) * stride + offsets.real.astype(np.int64)
    return np.asarray(padded.ravel()[(first + reach + 1)[:, None] + steps])


def _peaks(
    band: NDArray[np.float64], lattice: Lattice, at: NDArray[np.complex128]
) -> tuple[NDArray[np.complex128], NDArray[np.float64]]:
    """Return position and height of the highest pixel near each position."""
    offsets = _disc(max(SEARCH * lattice.pitch_px, 1.5))
    values = _around(band, at, offsets)
    values = np.where(np.isnan(values), -np.inf, values)
    highest = values.argmax(axis=1)
    middle = np.rint(at.real) + 1j * np.rint(at.imag)
    return middle + offsets[highest], values[np.arange(len(at)), highest]


def _model(offsets: NDArray[np.complex128], lattice: Lattice, width_px: float) -> NDArray[np.float64]:
    """Return the model of a cell (m, 4): a constant, x and y in pitches, and a Gaussian spot."""
    x, y = offsets.real / lattice.pitch_px, offsets.imag / lattice.pitch_px
    return np.stack([np.ones(len(x)), x, y, np.exp(-0.5 * (np.abs(offsets) / width_px) ** 2)], axis=1)


def _fits(
    values: NDArray[np.float64], inside: NDArray[np.bool_], model: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Fit the model to each cell; return parameters (n, 4) and inverse normal matrices (n, 4, 4)."""
    # A small ridge keeps the fit solvable for cells cut to a line by the edge of the frame.
    ridge = 1e-9 * len(model) * np.eye(4)
    inverse = np.tile(np.linalg.inv(model.T @ model + ridge), (len(values), 1, 1))
    cut = np.flatnonzero(~inside.all(axis=1))
    products = (model[:, :, None] * model[:, None, :]).reshape(-1, 16)
    inverse[cut] = np.linalg.inv((inside[cut] @ products).reshape(-1, 4, 4) + ridge)
    return np.einsum("nij,nj->ni", inverse, values @ model), inverse


def _subpixel(
    smooth: NDArray[np.float64], peaks: NDArray[np.complex128], slopes: NDArray[np.float64]
) -> NDArray[np.complex128]:
    """Return the offset from the peak pixel to the maximum of a parabola through it and its neighbours.

    The slopes (n, 2) of a plane are taken off: haze ends at the edge of the pupil, where its mean has one.
    """
    height, width = smooth.shape
    x = np.clip(peaks.real.astype(np.int64), 1, width - 2)
    y = np.clip(peaks.imag.astype(np.int64), 1, height - 2)

    def top(before: NDArray[np.float64], after: NDArray[np.float64], axis: int) -> NDArray[np.float64]:
        bend = before - 2 * smooth[y, x] + after
        shift = (0.5 * (before - after) + slopes[:, axis]) / np.where(bend < 0, bend, -np.inf)
        return np.clip(shift, -0.5, 0.5)

    shift_x = top(smooth[y, x - 1], smooth[y, x + 1], 0)
    return np.asarray(shift_x + 1j * top(smooth[y - 1, x], smooth[y + 1, x], 1))


def _coloured(
    image: NDArray[np.float64], band: NDArray[np.float64], lattice: Lattice, width_px: float
) -> float:
    """Return the additional pixel variance due to noise that is not white, such as stripes.

    Smoothing leaves 1 / (2 sqrt(pi) width) of white noise. The excess after smoothing is expressed as the
    variance of white noise that would leave as much.
    """
    smoothed = 2 * np.sqrt(np.pi) * width_px * _noise(band, lattice)
    return float(max(smoothed**2 - _noise(image, lattice) ** 2, 0.0))


def _noise(image: NDArray[np.float64], lattice: Lattice) -> float:
    """Return the standard deviation of the noise between the spots.

    The wings of spots are equal one step of the lattice away and the background changes linearly, so that
    second differences over one step contain only noise.
    """
    row, column = round(lattice.step.imag), round(lattice.step.real)
    height, width = image.shape
    every = int(np.ceil(np.sqrt(max(1.0, image.size / (4 * _MOST_FOR_NOISE)))))
    y = np.arange(abs(row), height - abs(row), every)
    x = np.arange(abs(column), width - abs(column), every)
    between = lattice.distance_px(y, x) > 0.5 * lattice.pitch_px
    if not between.any():
        return 0.0
    at = (y[:, None] * width + x)[between]
    step = row * width + column
    pixels = image.ravel()
    return float(robust_std(pixels[at - step] - 2 * pixels[at] + pixels[at + step]) / np.sqrt(6))
