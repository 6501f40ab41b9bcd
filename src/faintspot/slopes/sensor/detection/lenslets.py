"""Find the lenslets of a Shack-Hartmann sensor in a frame: geometry, pitch, angle and illumination."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from faintspot.base.checks import finite_array, number_between, one_of, real_array
from faintspot.base.errors import InputError
from faintspot.slopes.sensor.detection.following import follow
from faintspot.slopes.sensor.detection.illumination import Illumination, find_illumination
from faintspot.slopes.sensor.detection.kin import best_kin
from faintspot.slopes.sensor.detection.lattice import (
    RATIOS,
    SMALLEST_PITCH_PX,
    Lattice,
    find_lattice,
    robust_std,
)
from faintspot.slopes.sensor.detection.nodes import (
    Drift,
    NodeFlux,
    SpotFlux,
    find_spots,
    measure_nodes,
    no_drift,
    spot_width,
)
from faintspot.slopes.sensor.neighbours import as_rows, as_tree
from faintspot.slopes.sensor.region import PupilRegion, Rectangle

_FIT_PASSES = 4
# A spot with this signal-to-noise ratio that is as bright as those of illuminated lenslets and this far
# (pitches) from all of them belongs to another lenslet: a smooth aberration brings no two spots closer.
_CLEAR, _ELSEWHERE = 6.0, 0.5
# Displacements are followed if that reaches so many of these spots, or half of them (one may be a ghost), and
# the spots are this near (pitches, median) to their expected positions, unlike peaks within spots.
_REACHED, _FOLLOWED = 4, 0.15
# Share of such spots relative to illuminated lenslets above which the lattice is doubtful; rows cut off by
# the edge of the frame in a small array are fewer.
_PART_ELSEWHERE = 0.25
# Minimum shape similarity: fraction of the squared flux explained, relative to illuminated spots.
_LIKE = 0.6
_MOST_FOR_NOISE = 50_000  # pixels; the robust deviation of so many is known to 1 %
_SMALLEST_GIVEN_PITCH_PX = 4


@dataclass(frozen=True)
class LensletGrid:
    """Illuminated lenslets of a sensor and the regular lattice that fits them.

    Parameters
    ----------
    geometry : str
        "square" or "hexagonal".
    pitch_px : float
        Distance between neighbouring lenslets.
    angle_deg : float
        Angle of a row (direction of increasing column number) from +x towards +y, in [-45, 45) for a square
        and [-30, 30) for a hexagonal lattice. Row numbers increase in the direction 90 or 60 degrees
        further towards +y.
    cells : int array (n, 2)
        Row and column of each illuminated lenslet, ordered by row, then column; the smallest of each is 0.
    centres : float array (n, 2)
        x, y of the lattice nodes in frame pixels (pixel i is centred at i). They are the nodes of the regular
        lattice that fits all spots best, not the positions of the spots.
    flux : float array (n,)
        Flux above the local background in the units of the frame, within 2.5 spot widths (standard
        deviations) of the peak of the spot, at most half a pitch.
    drifts : float array (n, 2)
        x, y displacement of the spots by a smooth aberration [px]; 0 where none was followed.
    spots : float array (n, 2)
        x, y of the spot of each illuminated lenslet in frame pixels.
    spot_px : float
        Standard deviation of the spot shape.
    elsewhere : float array (m, 2)
        x, y of other spots that are as bright as those of illuminated lenslets.
    doubt : str
        Reason why the choice of illuminated lenslets may be wrong, in one line; empty if it is clear.
    """

    geometry: str
    pitch_px: float
    angle_deg: float
    cells: NDArray[np.int64]
    centres: NDArray[np.float64]
    flux: NDArray[np.float64]
    drifts: NDArray[np.float64]
    spots: NDArray[np.float64]
    spot_px: float
    elsewhere: NDArray[np.float64]
    doubt: str = ""


def find_lenslets(
    frame: Any,
    *,
    geometry: str = "auto",
    pitch_px: float | None = None,
    bad_pixels: Any = None,
    illuminated_fraction: float | None = None,
    pupil: Any = None,
    roi: Any = None,
) -> LensletGrid:
    """Find the lenslet grid in a frame without prior knowledge of the sensor.

    The lattice is found in the power spectrum of a map of spot-like features (see `lattice`), and refined by
    a robust least-squares fit to the spots at its nodes. The illuminated lenslets are chosen all together
    (see `illumination`). An illuminated lenslet
    has a spot that stands out of the noise of its own cell, enough flux above its own background, and
    mostly illuminated neighbours. Lenslets at the edge of the pupil with low flux and those behind the
    central obstruction are therefore omitted. So are lenslets whose node is within 0.12 pitch of the edge
    of the frame.

    Parameters
    ----------
    frame : array (ny, nx) or (n_frames, ny, nx)
        One frame, or several that are averaged (the extreme values of each pixel are ignored).
    geometry : str
        "auto", "square" or "hexagonal".
    pitch_px : float, optional
        Pitch, known within 20 %.
    bad_pixels : bool array (ny, nx), optional
        Pixels to ignore, which may be NaN. Hot pixels and cosmic rays are also found without it.
    illuminated_fraction : float, optional
        Smallest flux of an illuminated lenslet, relative to the median of the illuminated ones. Default: the
        value between 0.18 and 0.5 with the fewest lenslets near it.
    pupil : (x, y, radius) or (x, y, radius, inner radius), optional
        Disk or annulus in pixels: lenslets with nodes inside are used, whatever their flux.
    roi : (x0, y0, x1, y1), optional
        Part of the frame to use: columns x0 to x1 - 1 and rows y0 to y1 - 1.

    Returns
    -------
    LensletGrid
        Illuminated lenslets.

    Raises
    ------
    InputError
        If arguments are invalid, or no lattice of at least four illuminated lenslets in two rows and two
        columns stands out of the noise.

    Notes
    -----
    In simulations with spots displaced randomly by up to 15 % of the pitch per axis, the lattice was found
    in all frames at a signal-to-noise ratio (of a spot in a matched filter) of 4 with 140 lenslets, in 14
    of 16 at 5 with 40, and in 12 of 16 at 8 with 16 lenslets. At a ratio of 5, one sixth of the illuminated
    lenslets is missed.
    """
    one_of("geometry", geometry, ("auto", *RATIOS))
    if illuminated_fraction is not None:
        illuminated_fraction = number_between("illuminated_fraction", illuminated_fraction, 0.0, 1.0)
    frames, bad = _checked(frame, bad_pixels)
    part = Rectangle.given(roi, frames.shape[-2:])
    corner = complex(part.x0, part.y0)
    circle = None if pupil is None else PupilRegion.given(pupil).moved(-corner)
    image = _clean_image(frames[part.slices], bad[part.slices])
    geometries = tuple(RATIOS) if geometry == "auto" else (geometry,)
    pitch_range_px = _pitch_range(pitch_px, image.shape)
    found = find_lattice(image, geometries, pitch_range_px) if np.ptp(image) > 0 else None
    if found is None:
        raise InputError(_nothing_found(image, pitch_range_px, geometry))
    lattice, map_of_spots = found
    fit = _fitted(image, best_kin(map_of_spots, lattice, pitch_range_px), illuminated_fraction, circle)
    lattice, spots, illuminated = fit.lattice, fit.spots, fit.illuminated
    cells = spots.cells[illuminated.nodes]
    if len(cells) < 4 or np.any(np.ptp(cells, axis=0) < 1):
        raise InputError(_too_few(len(cells), lattice, circle))
    at = lattice.positions(cells) + corner
    return LensletGrid(
        geometry=lattice.geometry,
        pitch_px=lattice.pitch_px,
        angle_deg=lattice.angle_deg,
        cells=cells - cells.min(axis=0),
        centres=as_rows(at),
        flux=spots.flux[illuminated.nodes],
        drifts=as_rows(spots.drifts[illuminated.nodes]),
        spots=as_rows(spots.positions[illuminated.nodes] + corner),
        spot_px=fit.width_px,
        elsewhere=as_rows(fit.elsewhere + corner),
        doubt=illuminated.doubt,
    )


def _pitch_range(pitch_px: float | None, shape: tuple[int, ...]) -> tuple[float, float]:
    """Return the smallest and largest pitch to try: two rows must fit into the frame."""
    largest = min(shape) / 1.6
    if pitch_px is None:
        return SMALLEST_PITCH_PX, largest
    pitch_px = number_between("pitch_px", pitch_px, 0.0, low_open=True)
    if pitch_px < _SMALLEST_GIVEN_PITCH_PX:
        raise InputError(
            f"pitch_px = {pitch_px:g}: expected {_SMALLEST_GIVEN_PITCH_PX} to {largest:g}; spots of quad "
            "cells overlap too much to be found, --grid of faintspot layout gives their places"
        )
    if pitch_px > largest:
        raise InputError(
            f"pitch_px = {pitch_px:g}: expected at most {largest:g}, two rows of lenslets must fit into "
            f"{shape[1]} x {shape[0]} pixels"
        )
    return 0.8 * pitch_px, 1.2 * pitch_px


def _nothing_found(image: NDArray[np.float64], pitch_range_px: tuple[float, float], geometry: str) -> str:
    """Return a one-line message that no lattice was found, with the range searched and what to try."""
    if np.ptp(image) == 0:
        return f"frame: every pixel is {image.flat[0]:g}, expected an image of lenslet spots"
    kind = "square or hexagonal" if geometry == "auto" else geometry
    return (
        f"frame: found no {kind} lattice of spots with a pitch of {pitch_range_px[0]:.1f} to "
        f"{pitch_range_px[1]:.1f} px above the noise; average more frames, or give pitch_px or bad_pixels"
    )


def _too_few(count: int, lattice: Lattice, pupil: PupilRegion | None) -> str:
    """Return a one-line message that a lattice has too few illuminated lenslets."""
    found = f"frame: a {lattice.geometry} lattice with a pitch of {lattice.pitch_px:.1f} px fits best, but "
    expected = "expected at least two rows of two"
    if pupil is not None:
        return f"{found}{count} of its lenslets lie in the pupil given, {expected}"
    number = "none of its lenslets is" if count == 0 else f"only {count} of its lenslets {_be(count)}"
    return f"{found}{number} lit for certain, {expected}; average more frames, or give pitch_px"


def _be(count: int) -> str:
    return "is" if count == 1 else "are"


def _checked(frame: Any, bad_pixels: Any) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Return frame or frames and a mask of bad pixels, where the frame may be NaN."""
    frames = real_array("frame", frame, minimum_dimensions=2)
    if frames.ndim > 3:
        raise InputError(f"frame: expected (ny, nx) or (n_frames, ny, nx), got shape {frames.shape}")
    bad = np.zeros(frames.shape[-2:], dtype=bool)
    if bad_pixels is not None:
        bad = real_array("bad_pixels", bad_pixels) != 0
        if bad.shape != frames.shape[-2:]:
            raise InputError(
                f"bad_pixels: expected shape {frames.shape[-2:]} like the frame, got {bad.shape}"
            )
    return frames, bad


def _clean_image(frames: NDArray[Any], bad: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the mean frame, float64, with bad and hot pixels replaced by the median around them."""
    if min(frames.shape[-2:]) < 2 * SMALLEST_PITCH_PX:
        raise InputError(f"frame: expected at least 10 x 10 pixels, got shape {frames.shape}")
    if bad.mean() > 0.5:
        raise InputError(f"bad_pixels: {bad.sum()} of {bad.size} pixels are bad, expected at most half")
    if bad.any():
        frames = np.where(bad, np.median(frames[..., ~bad]).astype(frames.dtype), frames)
    image = _robust_mean(finite_array("frame", frames))
    bad = bad | _hot_pixels(image)
    return np.asarray(np.where(bad, _median_of_good(image, bad), image))


def _robust_mean(frames: NDArray[Any]) -> NDArray[np.float64]:
    """Return the mean of a cube from at most 12 group means, without the two extremes of each pixel."""
    if frames.ndim == 2:
        return frames.astype(np.float64)
    groups = np.array_split(frames, min(len(frames), 12))
    means = np.sort([group.mean(axis=0, dtype=np.float64) for group in groups], axis=0)
    trimmed = means[1:-1] if len(means) > 2 else means
    return np.asarray(trimmed.mean(axis=0))


def _hot_pixels(image: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return a mask of hot pixels and cosmic rays.

    The flux of a spot extends to at least three of a pixel's eight neighbours; that of a hot pixel to none,
    and the track of a cosmic ray to two.
    """
    padded = np.pad(image, 1, mode="edge")
    mean = (scipy.ndimage.uniform_filter(image, 3, mode="nearest") * 9 - image) / 8
    above = image - mean
    every = max(1, image.size // _MOST_FOR_NOISE)
    noise = robust_std(above.ravel()[::every])
    # With two neighbours on a track, three quarters of a pixel's excess over the mean of all eight remain.
    row, column = np.nonzero(above > 0.75 * 5 * noise)
    around = [(y, x) for y in range(3) for x in range(3) if (y, x) != (1, 1)]
    ring = np.sort(np.stack([padded[row + y, column + x] for y, x in around]), axis=0)
    peak = image[row, column]
    lowest, median, third = ring[1], 0.5 * (ring[3] + ring[4]), ring[5]
    bad = np.zeros(image.shape, dtype=bool)
    bad[row, column] = (peak - median > 5 * noise) & (third - lowest < 0.2 * (peak - lowest))
    return bad


def _median_of_good(image: NDArray[np.float64], bad: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Replace each bad pixel by the median of the good pixels in the 5 x 5 around it."""
    filled = image.copy()
    padded = np.pad(np.where(bad, np.nan, image), 2, constant_values=np.nan)
    y, x = np.nonzero(bad)
    around = np.lib.stride_tricks.sliding_window_view(padded, (5, 5))[y, x].reshape(len(y), 25)
    empty = np.isnan(around).all(axis=1)
    around[empty] = np.median(image[~bad])
    filled[y, x] = np.nanmedian(around, axis=1) if len(y) else 0.0
    return filled


@dataclass(frozen=True)
class _Fit:
    """Lattice fitted to the spots, with measurements at its nodes and their illumination.

    `bright` are all spots as bright as the illuminated ones, `elsewhere` those of them at no
    illuminated node.
    """

    lattice: Lattice
    width_px: float
    spots: NodeFlux
    illuminated: Illumination
    bright: NDArray[np.complex128]
    elsewhere: NDArray[np.complex128]


def _fitted(
    image: NDArray[np.float64],
    lattice: Lattice,
    illuminated_fraction: float | None,
    pupil: PupilRegion | None,
) -> _Fit:
    """Fit the lattice to the spots; if some are left over, follow them from neighbour to neighbour."""
    image = image - np.median(image)
    width_px = spot_width(image, lattice)
    for _ in range(_FIT_PASSES):
        spots = measure_nodes(image, lattice, width_px)
        illuminated = find_illumination(spots, lattice, illuminated_fraction)
        used = (
            illuminated.nodes
            if pupil is None
            else illuminated.nodes & pupil.holds(lattice.positions(spots.cells))
        )
        if np.count_nonzero(used) < 4:
            break
        before = lattice
        lattice = lattice.fitted(spots.cells[used], spots.positions[used]).canonical(image.shape)
        if abs(lattice.step - before.step) * max(image.shape) < 0.02 * abs(lattice.step) ** 2:
            break
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
        near = np.median(np.abs(better.spots.shifts[better.illuminated.nodes])) < _FOLLOWED
        if not near or reached < max(1.0, min(_REACHED, 0.5 * len(fit.elsewhere))):
            break
        fit = better
    if pupil is not None:
        held = pupil.holds(fit.lattice.positions(fit.spots.cells))
        return replace(fit, illuminated=replace(fit.illuminated, nodes=held, doubt=""))
    return replace(fit, illuminated=replace(fit.illuminated, doubt=_too_many(fit) or fit.illuminated.doubt))


def _too_many(fit: _Fit) -> str:
    """Return a one-line warning if the lattice explains only a part of the flux."""
    count, illuminated = len(fit.elsewhere), int(np.count_nonzero(fit.illuminated.nodes))
    if count <= _PART_ELSEWHERE * illuminated:
        return ""
    return (
        f"{count} spots as bright as those of the {illuminated} lit lenslets belong to none of them, so that "
        "the lattice explains only a part of the flux; its pitch or geometry may be wrong, give one of them"
    )


def _illuminated_of(
    image: NDArray[np.float64],
    lattice: Lattice,
    width_px: float,
    illuminated_fraction: float | None,
    everywhere: SpotFlux,
    drift: Drift = no_drift,
) -> _Fit:
    """Decide which lenslets of a lattice are illuminated, and which bright spots belong to none of them."""
    spots = measure_nodes(image, lattice, width_px, drift)
    illuminated = find_illumination(spots, lattice, illuminated_fraction)
    elsewhere = bright = np.empty(0, dtype=np.complex128)
    if illuminated.nodes.any():
        likeness = float(np.median(spots.likeness[illuminated.nodes]))
        bright = everywhere.positions[_bright(everywhere, illuminated, likeness)]
        distance = as_tree(spots.positions[illuminated.nodes]).query(as_rows(bright))[0]
        elsewhere = bright[distance > _ELSEWHERE * lattice.pitch_px]
    return _Fit(lattice, width_px, spots, illuminated, bright, elsewhere)


def _bright(spots: SpotFlux, illuminated: Illumination, likeness: float) -> NDArray[np.bool_]:
    """Return which spots are as bright as those of illuminated lenslets, and of similar shape."""
    clear = (spots.signal_to_noise > _CLEAR) & (spots.likeness > _LIKE * likeness)
    return np.asarray(clear & (spots.flux >= illuminated.least_flux))
