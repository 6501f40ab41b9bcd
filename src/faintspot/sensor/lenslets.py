"""Find the lenslets of a Shack-Hartmann sensor in a frame: geometry, pitch, angle, and which are lit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from faintspot.checks import finite_array, number_between, one_of, real_array
from faintspot.errors import InputError
from faintspot.sensor.lattice import (
    RATIOS,
    SMALLEST_PITCH_PX,
    Lattice,
    count_chosen,
    find_lattice,
    median_where,
    pixels_around,
    robust_std,
)

# A spot is looked for within this part of the pitch around its node: aberrations of +-15 % of the pitch per
# axis and an error of the first lattice fit in, the neighbour's spot does not.
_SEARCH = 0.35
# A node this near to the frame's edge (part of the pitch) has its spot cut in two.
_MARGIN = 0.12
# Signal-to-noise ratios (of the smoothed spot) at which a spot is there for certain, and at which it is
# believed when at least half of its neighbours are lit.
_CERTAIN, _PROBABLE = 4.0, 3.0
# A spot falls off on all sides: over the brightest of the four sides of its cell it keeps at least this part
# of its height. An edge or a band of diffuse light does not.
_ROUND = 0.35
_FIT_PASSES = 4


@dataclass(frozen=True)
class LensletGrid:
    """The lit lenslets of a sensor and the regular lattice that they lie on.

    Parameters
    ----------
    geometry : str
        "square" or "hexagonal".
    pitch_px : float
        Distance between neighbouring lenslets.
    angle_deg : float
        Angle of a row (column number growing) from +x towards +y, in [-45, 45) for a square and [-30, 30)
        for a hexagonal lattice. Row numbers grow in the direction 90 or 60 degrees further towards +y.
    cells : int array (n, 2)
        Row and column of every lit lenslet, ordered by row, then column; the smallest of each is 0.
    centres : float array (n, 2)
        x, y of the lattice's nodes in frame pixels, pixel i having its centre at i. They are the nodes of
        the regular lattice that fits all spots best, not the positions of the spots.
    flux : float array (n,)
        Flux above the local background in the frame's units, within 2.5 spot widths (standard deviations)
        of the spot's peak, at most half a pitch.
    """

    geometry: str
    pitch_px: float
    angle_deg: float
    cells: NDArray[np.int64]
    centres: NDArray[np.float64]
    flux: NDArray[np.float64]


@dataclass(frozen=True)
class _Peaks:
    """What was measured at every node of the lattice inside the frame.

    cells (n, 2); positions of the peaks x + 1j * y, heights above the background in a smoothed image, and
    that background, each (n,).
    """

    cells: NDArray[np.int64]
    positions: NDArray[np.complex128]
    heights: NDArray[np.float64]
    background: NDArray[np.float64]


@dataclass(frozen=True)
class _Measured(_Peaks):
    """The peaks, which of them fall off on all sides, their flux and signal-to-noise ratio, each (n,)."""

    is_round: NDArray[np.bool_]
    flux: NDArray[np.float64]
    signal_to_noise: NDArray[np.float64]


def find_lenslets(
    frame: Any,
    *,
    geometry: str = "auto",
    pitch_px: float | None = None,
    bad_pixels: Any = None,
    lit_fraction: float = 0.3,
) -> LensletGrid:
    """Find the lenslet grid in a frame, without knowing anything about the sensor.

    The lattice comes from the power spectrum of a map of everything that looks like a spot (see
    faintspot.sensor.lattice), then from a robust least-squares fit to the spots at its nodes. A lenslet is
    lit when its spot stands above the noise and has at least `lit_fraction` of the median flux, so partly
    lit lenslets at the pupil's edge and those behind the central obstruction are left out, and so is one
    whose node lies within 0.12 pitch of the frame's edge.

    Parameters
    ----------
    frame : array (ny, nx) or (n_frames, ny, nx)
        One frame, or several that are averaged (each pixel's extreme values left out).
    geometry : str
        "auto", "square" or "hexagonal".
    pitch_px : float, optional
        The pitch, known within 20 %.
    bad_pixels : bool array (ny, nx), optional
        Pixels to ignore; they may hold NaN. Hot pixels and cosmic rays are found without it.
    lit_fraction : float
        The smallest flux of a lit lenslet, as a part of the median of the lit ones.

    Returns
    -------
    LensletGrid
        The lit lenslets.

    Raises
    ------
    InputError
        When the arguments are wrong, or when no lattice of at least four lit lenslets in two rows and two
        columns stands out of the noise.

    Notes
    -----
    In simulation, spots shifted at random by up to 15 % of the pitch per axis: the lattice was found in all
    frames at a signal-to-noise ratio (of a spot in a matched filter) of 4 with 140 lenslets, in 14 of 16 at 5
    with 40, and in 12 of 16 at 8 with 16 lenslets. At a ratio of 5 a sixth of the lit lenslets is missed.
    """
    one_of("geometry", geometry, ("auto", *RATIOS))
    lit_fraction = number_between("lit_fraction", lit_fraction, 0.0, 1.0)
    image = _clean_image(frame, bad_pixels)
    geometries = tuple(RATIOS) if geometry == "auto" else (geometry,)
    pitch_range_px = _pitch_range(pitch_px, image.shape)
    lattice = find_lattice(image, geometries, pitch_range_px) if np.ptp(image) > 0 else None
    if lattice is None:
        raise InputError(_nothing_found(image, pitch_range_px, geometry))
    lattice, spots, lit = _fitted(image, lattice, lit_fraction)
    cells = spots.cells[lit]
    if len(cells) < 4 or np.any(np.ptp(cells, axis=0) < 1):
        raise InputError(
            f"frame: found only {len(cells)} lit lenslets at a pitch of {lattice.pitch_px:.1f} px, expected "
            "at least two rows of two; average more frames, or give pitch_px"
        )
    at = lattice.positions(cells)
    return LensletGrid(
        geometry=lattice.geometry,
        pitch_px=lattice.pitch_px,
        angle_deg=lattice.angle_deg,
        cells=cells - cells.min(axis=0),
        centres=np.column_stack([at.real, at.imag]),
        flux=spots.flux[lit],
    )


def _pitch_range(pitch_px: float | None, shape: tuple[int, ...]) -> tuple[float, float]:
    """Return the smallest and largest pitch to try: two rows must fit into the frame."""
    largest = min(shape) / 1.6
    if pitch_px is None:
        return SMALLEST_PITCH_PX, largest
    pitch_px = number_between("pitch_px", pitch_px, 3.0, largest)
    return 0.8 * pitch_px, 1.2 * pitch_px


def _nothing_found(image: NDArray[np.float64], pitch_range_px: tuple[float, float], geometry: str) -> str:
    """Say in one line that there is no lattice, what there is, and what to try."""
    if np.ptp(image) == 0:
        return f"frame: every pixel is {image.flat[0]:g}, expected an image of lenslet spots"
    kind = "square or hexagonal" if geometry == "auto" else geometry
    return (
        f"frame: found no {kind} lattice of spots with a pitch of {pitch_range_px[0]:.1f} to "
        f"{pitch_range_px[1]:.1f} px above the noise; average more frames, or give pitch_px or bad_pixels"
    )


def _clean_image(frame: Any, bad_pixels: Any) -> NDArray[np.float64]:
    """Return the mean frame, float64, with bad and hot pixels replaced by the median around them."""
    frames = real_array("frame", frame, minimum_dimensions=2)
    if frames.ndim > 3:
        raise InputError(f"frame: expected (ny, nx) or (n_frames, ny, nx), got shape {frames.shape}")
    if min(frames.shape[-2:]) < 2 * SMALLEST_PITCH_PX:
        raise InputError(f"frame: expected at least 10 x 10 pixels, got shape {frames.shape}")
    bad = np.zeros(frames.shape[-2:], dtype=bool)
    if bad_pixels is not None:
        bad = real_array("bad_pixels", bad_pixels) != 0
        if bad.shape != frames.shape[-2:]:
            raise InputError(
                f"bad_pixels: expected shape {frames.shape[-2:]} like the frame, got {bad.shape}"
            )
        if bad.mean() > 0.5:
            raise InputError(f"bad_pixels: {bad.sum()} of {bad.size} pixels are bad, expected at most half")
        frames = np.where(bad, np.median(frames[..., ~bad]).astype(frames.dtype), frames)
    image = _robust_mean(finite_array("frame", frames))
    bad = bad | _hot_pixels(image)
    return np.asarray(np.where(bad, _median_of_good(image, bad), image))


def _robust_mean(frames: NDArray[Any]) -> NDArray[np.float64]:
    """Return the mean of a cube: of at most 12 group means, each pixel's two extremes left out."""
    if frames.ndim == 2:
        return frames.astype(np.float64)
    groups = np.array_split(frames, min(len(frames), 12))
    means = np.sort([group.mean(axis=0, dtype=np.float64) for group in groups], axis=0)
    trimmed = means[1:-1] if len(means) > 2 else means
    return np.asarray(trimmed.mean(axis=0))


def _hot_pixels(image: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return the pixels of hot pixels and cosmic rays.

    The light of a spot reaches at least three of a pixel's eight neighbours; a hot pixel reaches none and the
    track of a cosmic ray two.
    """
    ring = np.ones((3, 3), dtype=bool)
    ring[1, 1] = False
    background = scipy.ndimage.median_filter(image, footprint=ring, mode="nearest")
    third = scipy.ndimage.rank_filter(image, -3, footprint=ring, mode="nearest")
    excess = image - background
    noise = robust_std(excess)
    return np.asarray((excess > 5 * noise) & (third - background < 0.2 * excess))


def _median_of_good(image: NDArray[np.float64], bad: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the median of the good pixels among the 5 x 5 around every bad one (elsewhere the image)."""
    filled = image.copy()
    padded = np.pad(np.where(bad, np.nan, image), 2, constant_values=np.nan)
    y, x = np.nonzero(bad)
    around = np.lib.stride_tricks.sliding_window_view(padded, (5, 5))[y, x].reshape(len(y), 25)
    empty = np.isnan(around).all(axis=1)
    around[empty] = np.median(image[~bad])
    filled[y, x] = np.nanmedian(around, axis=1) if len(y) else 0.0
    return filled


def _fitted(
    image: NDArray[np.float64], lattice: Lattice, lit_fraction: float
) -> tuple[Lattice, _Measured, NDArray[np.bool_]]:
    """Return the lattice fitted to the spots, what was measured at its nodes, and which nodes are lit."""
    image = image - np.median(image)
    width_px = _spot_width(image, lattice)
    for _ in range(_FIT_PASSES):
        spots = _measured(image, lattice, width_px)
        lit = _lit(spots, lattice, lit_fraction)
        if lit.sum() < 4:
            break
        before, lattice = (
            lattice,
            lattice.fitted(spots.cells[lit], spots.positions[lit]).canonical(image.shape),
        )
        if abs(lattice.step - before.step) * max(image.shape) < 0.02 * abs(lattice.step) ** 2:
            break
    spots = _measured(image, lattice, width_px)
    return lattice, spots, _lit(spots, lattice, lit_fraction)


def _spot_width(image: NDArray[np.float64], lattice: Lattice) -> float:
    """Return the standard deviation of the Gaussian that is most like the spots.

    A Gaussian filter of width s turns a Gaussian spot of width s0 into a peak proportional to
    1 / (s^2 + s0^2) and white noise into noise proportional to 1 / s: their ratio is highest at s = s0.
    """
    widths = np.geomspace(0.6, max(1.2, lattice.pitch_px / 4), 8)
    ratios = []
    for width in widths:
        smooth = _smoothed(image, width)
        heights = _peaks(smooth, lattice).heights
        certain = heights[heights >= _CERTAIN * _noise(smooth, lattice)]
        # The sum, as the right width also makes most spots stand out; clipped, for a cosmic ray among them.
        limit = 3 * np.median(certain) if len(certain) else 0.0
        ratios.append(width * float(np.minimum(certain, limit).sum()))
    return float(widths[int(np.argmax(ratios))])


def _smoothed(image: NDArray[np.float64], width_px: float) -> NDArray[np.float64]:
    """Return the smoothed image, dark outside the frame: a mirrored spot would move the peak to the edge."""
    return np.asarray(scipy.ndimage.gaussian_filter(image, width_px, mode="constant"))


def _peaks(smooth: NDArray[np.float64], lattice: Lattice) -> _Peaks:
    """Return the highest pixel near every node, and how it stands above the border of the node's cell."""
    cells = lattice.cells_inside(smooth.shape, _MARGIN * lattice.pitch_px)
    at = lattice.positions(cells)
    values, distance, pixels = pixels_around(smooth, at, 0.6 * lattice.pitch_px)
    border = _at_border(distance, values, lattice)
    near = np.where((distance < _SEARCH * lattice.pitch_px) & ~np.isnan(values), values, -np.inf)
    index = np.arange(len(cells))
    peak = near.argmax(axis=1)
    positions = pixels[index, peak]
    background = median_where(values, border)
    height = near[index, peak] - background
    return _Peaks(cells, positions, height, background)


def _is_round(smooth: NDArray[np.float64], peaks: _Peaks, lattice: Lattice) -> NDArray[np.bool_]:
    """Return which peaks fall off on all sides, as a spot does and the edge of something does not."""
    above_sides = peaks.heights + peaks.background - _brightest_side(smooth, peaks.positions, lattice)
    x, y = peaks.positions.real, peaks.positions.imag
    height, width = smooth.shape
    # What rises towards the rim of the search area or of the frame belongs to something beyond it.
    inside = (x > 0) & (x < width - 1) & (y > 0) & (y < height - 1)
    tops = scipy.ndimage.maximum_filter(smooth, 3) == smooth
    inside &= tops[y.astype(np.int64), x.astype(np.int64)]
    return np.asarray(inside & (above_sides >= _ROUND * peaks.heights))


def _brightest_side(
    smooth: NDArray[np.float64], positions: NDArray[np.complex128], lattice: Lattice
) -> NDArray[np.float64]:
    """Return the highest of the medians of the four sides, half a pitch away, of every position."""
    values, distance, pixels = pixels_around(smooth, positions, 0.6 * lattice.pitch_px)
    border = _at_border(distance, values, lattice)
    angle = np.angle((pixels - positions[:, None]) / lattice.step)
    side = np.rint(angle / (np.pi / 2)).astype(np.int64) % 4
    return np.asarray(
        np.max([median_where(values, border & (side == number)) for number in range(4)], axis=0)
    )


def _at_border(
    distance: NDArray[np.float64], values: NDArray[np.float64], lattice: Lattice
) -> NDArray[np.bool_]:
    """Return which pixels of the windows lie about half a pitch from the middle, and in the frame."""
    parts = distance / lattice.pitch_px
    return np.asarray((parts > 0.42) & (parts < 0.6) & ~np.isnan(values))


def _measured(image: NDArray[np.float64], lattice: Lattice, width_px: float) -> _Measured:
    """Return what is at every node of the lattice inside the frame."""
    smooth = _smoothed(image, width_px)
    peaks = _peaks(smooth, lattice)
    radius = max(1.5, min(2.5 * width_px, 0.5 * lattice.pitch_px))
    values, distance, _ = pixels_around(image, peaks.positions, radius)
    above = np.where(distance <= radius, values - peaks.background[:, None], 0.0)
    noise = max(_noise(smooth, lattice), 1e-12 * float(np.ptp(image)))
    return _Measured(
        peaks.cells,
        peaks.positions + _subpixel(smooth, peaks.positions),
        peaks.heights,
        peaks.background,
        is_round=_is_round(smooth, peaks, lattice),
        flux=np.nansum(above, axis=1),
        signal_to_noise=peaks.heights / noise,
    )


def _subpixel(smooth: NDArray[np.float64], peaks: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Return how far from the peak pixel the top of a parabola through it and its neighbours lies."""
    height, width = smooth.shape
    x = np.clip(peaks.real.astype(np.int64), 1, width - 2)
    y = np.clip(peaks.imag.astype(np.int64), 1, height - 2)

    def top(
        before: NDArray[np.float64], here: NDArray[np.float64], after: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        bend = before - 2 * here + after
        shift = 0.5 * (before - after) / np.where(bend < 0, bend, -np.inf)
        return np.clip(shift, -0.5, 0.5)

    here = smooth[y, x]
    shift_x = top(smooth[y, x - 1], here, smooth[y, x + 1])
    return np.asarray(shift_x + 1j * top(smooth[y - 1, x], here, smooth[y + 1, x]))


def _noise(smooth: NDArray[np.float64], lattice: Lattice) -> float:
    """Return the standard deviation of the smoothed noise between the spots.

    The wings of the spots are the same one step of the lattice away and the background changes evenly, so
    that second differences over one step are noise.
    """
    between = lattice.distance_px(smooth.shape) > 0.5 * lattice.pitch_px
    step = np.array([round(lattice.step.imag), round(lattice.step.real)])
    after, before = (scipy.ndimage.shift(smooth, sign * step, order=0, cval=np.nan) for sign in (-1, 1))
    difference = (after - 2 * smooth + before)[between]
    difference = difference[np.isfinite(difference)]
    return robust_std(difference) / np.sqrt(6) if len(difference) else 0.0


def _lit(spots: _Measured, lattice: Lattice, lit_fraction: float) -> NDArray[np.bool_]:
    """Return which nodes are lit: their spot is there, is bright enough, and has a lit neighbour."""
    neighbours = lattice.neighbours(spots.cells)
    certain = spots.is_round & (spots.signal_to_noise >= _CERTAIN)
    if not certain.any():
        return certain
    bright = spots.flux >= lit_fraction * np.median(spots.flux[certain])
    lit = certain & bright
    probable = spots.is_round & (spots.signal_to_noise >= _PROBABLE) & bright
    for _ in range(3):
        lit = lit | (probable & (2 * count_chosen(lit, neighbours) >= neighbours.shape[1]))
    return np.asarray(lit & (count_chosen(lit, neighbours) > 0))
