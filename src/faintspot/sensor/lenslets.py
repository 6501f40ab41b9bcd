"""Find the lenslets of a Shack-Hartmann sensor in a frame: geometry, pitch, angle, and which are lit."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from faintspot.base.checks import finite_array, number_between, one_of, real_array
from faintspot.base.errors import InputError
from faintspot.sensor.following import follow
from faintspot.sensor.illumination import Illumination, find_illumination
from faintspot.sensor.kin import best_kin
from faintspot.sensor.lattice import RATIOS, SMALLEST_PITCH_PX, Lattice, find_lattice, robust_std
from faintspot.sensor.nodes import (
    Drift,
    NodeFlux,
    SpotFlux,
    find_spots,
    measure_nodes,
    no_drift,
    spot_width,
)
from faintspot.sensor.region import PupilRegion, Rectangle

_FIT_PASSES = 4
# A spot of this signal-to-noise ratio that is as bright as lit ones and this far (pitches) from all of them
# belongs to another lenslet: a smooth aberration brings two spots no closer.
_CLEAR, _ELSEWHERE = 6.0, 0.5
# Displacements are followed when that reaches so many of these spots, or half of them (one may be a ghost's),
# and the spots lie this near (pitches, median) to where they are then expected, unlike peaks within spots.
_REACHED, _FOLLOWED = 4, 0.15
# More of them than this share of the lit lenslets make the lattice doubtful; the rows that the frame's edge
# cuts off a small array are fewer.
_PART_ELSEWHERE = 0.25
# Its shape is like that of the lit ones: it explains at least this part of what it explains of theirs.
_LIKE = 0.6
_MOST_FOR_NOISE = 50_000  # pixels; the robust deviation of so many is known to 1 %
_SMALLEST_GIVEN_PITCH_PX = 4


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
    drifts : float array (n, 2)
        x, y from the centres to where a smooth aberration moves the spots, px; 0 where none was followed.
    spots : float array (n, 2)
        x, y of each lit lenslet's spot in frame pixels.
    spot_px : float
        Standard deviation of the spots' shape.
    elsewhere : float array (m, 2)
        x, y of the other spots that are as bright as those of lit lenslets.
    doubt : str
        Why the choice of lit lenslets may be wrong, in one line; empty when it is clear.
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
    """Find the lenslet grid in a frame, without knowing anything about the sensor.

    The lattice comes from the power spectrum of a map of everything that looks like a spot (see
    faintspot.sensor.lattice), then from a robust least-squares fit to the spots at its nodes. Which lenslets
    are lit is decided for all together (see faintspot.sensor.illumination):
    a lit one has a spot that stands out of
    the noise of its own cell, enough flux above its own background, and mostly lit neighbours. So lenslets at
    the pupil's edge with low flux and those behind the central obstruction are left out, and so is one
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
    illuminated_fraction : float, optional
        The smallest flux of a lit lenslet, as a part of the median of the lit ones. Default: the part between
        0.18 and 0.5 that the fewest lenslets have.
    pupil : (x, y, radius) or (x, y, radius, inner radius), optional
        In pixels: the lenslets whose nodes lie in this disk or annulus are taken, whatever their flux.
    roi : (x0, y0, x1, y1), optional
        Only columns x0 to x1 - 1 and rows y0 to y1 - 1 are looked at.

    Returns
    -------
    LensletGrid
        The lit lenslets.

    Raises
    ------
    InputError
        If the arguments are wrong, or when no lattice of at least four lit lenslets in two rows and two
        columns stands out of the noise.

    Notes
    -----
    In simulation, spots shifted at random by up to 15 % of the pitch per axis: the lattice was found in all
    frames at a signal-to-noise ratio (of a spot in a matched filter) of 4 with 140 lenslets, in 14 of 16 at 5
    with 40, and in 12 of 16 at 8 with 16 lenslets. At a ratio of 5 a sixth of the lit lenslets is missed.
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
        centres=_rows(at),
        flux=spots.flux[illuminated.nodes],
        drifts=_rows(spots.drifts[illuminated.nodes]),
        spots=_rows(spots.positions[illuminated.nodes] + corner),
        spot_px=fit.width_px,
        elsewhere=_rows(fit.elsewhere + corner),
        doubt=illuminated.doubt,
    )


def _rows(at: NDArray[np.complex128]) -> NDArray[np.float64]:
    """Return complex positions as rows of x, y."""
    return np.column_stack([at.real, at.imag])


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
    """Say in one line that there is no lattice, what there is, and what to try."""
    if np.ptp(image) == 0:
        return f"frame: every pixel is {image.flat[0]:g}, expected an image of lenslet spots"
    kind = "square or hexagonal" if geometry == "auto" else geometry
    return (
        f"frame: found no {kind} lattice of spots with a pitch of {pitch_range_px[0]:.1f} to "
        f"{pitch_range_px[1]:.1f} px above the noise; average more frames, or give pitch_px or bad_pixels"
    )


def _too_few(count: int, lattice: Lattice, pupil: PupilRegion | None) -> str:
    """Say in one line that a lattice has too few lit lenslets."""
    found = f"frame: a {lattice.geometry} lattice with a pitch of {lattice.pitch_px:.1f} px fits best, but "
    expected = "expected at least two rows of two"
    if pupil is not None:
        return f"{found}{count} of its lenslets lie in the pupil given, {expected}"
    number = "none of its lenslets is" if count == 0 else f"only {count} of its lenslets {_be(count)}"
    return f"{found}{number} lit for certain, {expected}; average more frames, or give pitch_px"


def _be(count: int) -> str:
    return "is" if count == 1 else "are"


def _checked(frame: Any, bad_pixels: Any) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Return frame or frames and a mask of bad pixels, which may hold NaN in the frame."""
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
    """Return the mean of a cube: of at most 12 group means, each pixel's two extremes left out."""
    if frames.ndim == 2:
        return frames.astype(np.float64)
    groups = np.array_split(frames, min(len(frames), 12))
    means = np.sort([group.mean(axis=0, dtype=np.float64) for group in groups], axis=0)
    trimmed = means[1:-1] if len(means) > 2 else means
    return np.asarray(trimmed.mean(axis=0))


def _hot_pixels(image: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return the pixels of hot pixels and cosmic rays.

    The flux of a spot reaches at least three of a pixel's eight neighbours; a hot pixel reaches none and the
    track of a cosmic ray two.
    """
    padded = np.pad(image, 1, mode="edge")
    mean = (scipy.ndimage.uniform_filter(image, 3, mode="nearest") * 9 - image) / 8
    above = image - mean
    every = max(1, image.size // _MOST_FOR_NOISE)
    noise = robust_std(above.ravel()[::every])
    # Two neighbours on its track leave three quarters of a pixel's excess over the mean of all eight.
    row, column = np.nonzero(above > 0.75 * 5 * noise)
    around = [(y, x) for y in range(3) for x in range(3) if (y, x) != (1, 1)]
    ring = np.sort(np.stack([padded[row + y, column + x] for y, x in around]), axis=0)
    peak = image[row, column]
    lowest, median, third = ring[1], 0.5 * (ring[3] + ring[4]), ring[5]
    bad = np.zeros(image.shape, dtype=bool)
    bad[row, column] = (peak - median > 5 * noise) & (third - lowest < 0.2 * (peak - lowest))
    return bad


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


@dataclass(frozen=True)
class _Fit:
    """A lattice fitted to the spots, what was measured at its nodes, and which are lit.

    `bright` are all spots as bright as the lit ones, `elsewhere` those of them that belong to no lit node.
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
    """Fit the lattice to the spots; where spots are left over, follow them from neighbour to neighbour."""
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
    """Say in one line when the lattice explains only a part of the flux."""
    count, illuminated = len(fit.elsewhere), int(np.count_nonzero(fit.illuminated.nodes))
    if count <= _PART_ELSEWHERE * illuminated:
        return ""
    return (
        f"{count} spots as bright as those of the {illuminated} lit lenslets belong to none of them, so the "
        "explains only a part of the flux; its pitch or geometry may be wrong, give pitch_px or geometry"
    )


def _illuminated_of(
    image: NDArray[np.float64],
    lattice: Lattice,
    width_px: float,
    illuminated_fraction: float | None,
    everywhere: SpotFlux,
    drift: Drift = no_drift,
) -> _Fit:
    """Decide which lenslets of a lattice are lit, and which bright spots belong to none of them."""
    spots = measure_nodes(image, lattice, width_px, drift)
    illuminated = find_illumination(spots, lattice, illuminated_fraction)
    elsewhere = bright = np.empty(0, dtype=np.complex128)
    if illuminated.nodes.any():
        likeness = float(np.median(spots.likeness[illuminated.nodes]))
        bright = everywhere.positions[_bright(everywhere, illuminated, likeness)]
        distance = cKDTree(_rows(spots.positions[illuminated.nodes])).query(_rows(bright))[0]
        elsewhere = bright[distance > _ELSEWHERE * lattice.pitch_px]
    return _Fit(lattice, width_px, spots, illuminated, bright, elsewhere)


def _bright(spots: SpotFlux, illuminated: Illumination, likeness: float) -> NDArray[np.bool_]:
    """Return which spots are as bright as those of lit lenslets, and about of their shape."""
    clear = (spots.signal_to_noise > _CLEAR) & (spots.likeness > _LIKE * likeness)
    return np.asarray(clear & (spots.flux >= illuminated.least_flux))
