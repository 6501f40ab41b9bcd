"""Find the lenslets of a Shack-Hartmann sensor in a frame: geometry, pitch, angle and illumination."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from faintspot.base.checks import check_shape, finite_array, number_between, one_of, real_array
from faintspot.base.errors import InputError
from faintspot.slopes.sensor.detection.candidates import RATIOS, SMALLEST_PITCH_PX, Lattice, robust_std
from faintspot.slopes.sensor.detection.few_spots import Stated, few_spots
from faintspot.slopes.sensor.detection.fits import LatticeFit, best_fit
from faintspot.slopes.sensor.region import PupilRegion, Rectangle, as_rows, as_tree

_MOST_FOR_NOISE = 50_000  # pixels; the robust deviation of so many is known to 1 %
_SMALLEST_GIVEN_PITCH_PX = 4
_KNOWN = "--grid of faintspot layout states an array of up to 4 x 4 lenslets, or quad cells"
# Distance from a node (pitches) within which a hot pixel may be a sharp spot, and standard deviations by
# which there must be more of these than of hot pixels by chance; and which part of them must be.
_ON_NODE, _BEYOND_CHANCE, _MOSTLY = 0.2, 5.0, 0.7
# Pitches from a lit lenslet within which a dark one may have lost its spot as a hot pixel, and the least part
# of a spot's flux in its brightest pixel.
_BESIDE, _PEAK = 1.5, 0.25


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
        x, y of other spots that are as bright as those of illuminated lenslets, and of hot pixels that may be
        the spots of dark ones.
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
    frame: object,
    *,
    geometry: str = "auto",
    pitch_px: float | None = None,
    bad_pixels: object = None,
    illuminated_fraction: float | None = None,
    pupil: object = None,
    roi: object = None,
    angle_deg: float | None = None,
    grid: tuple[int, int] | None = None,
) -> LensletGrid:
    """Find the lenslet grid in a frame without prior knowledge of the sensor.

    Candidate lattices are found in the autocorrelation of maps of spot-like features (see `candidates`). Each
    is refined by a robust least-squares fit to the spots at its nodes, and its illuminated lenslets are
    chosen all together (see `illumination`). The first lattice is used whose lenslets have almost all of the
    bright spots and few dark ones between them; there is a doubt if no lattice has. An illuminated lenslet
    has a spot that stands out of the noise of its own cell, enough flux above its own background, and
    mostly illuminated neighbours. Arrays of at most 4 x 4 lenslets, down to a single one, are found spot by
    spot (see `few_spots`). Lenslets at the edge of the pupil with low flux and those behind the
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
    angle_deg : float, optional
        Angle of the rows, for an array of at most 4 x 4 lenslets.
    grid : (int, int), optional
        Rows and columns of such an array, in either order.

    Returns
    -------
    LensletGrid
        Illuminated lenslets.

    Raises
    ------
    InputError
        If arguments are invalid, or no lattice stands out of the noise.

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
    raw = _mean_image(frames[part.slices], bad[part.slices])
    hot = _hot_pixels(raw) & ~bad[part.slices]
    geometries = tuple(RATIOS) if geometry == "auto" else (geometry,)
    pitch_range_px = _pitch_range(pitch_px, raw.shape)
    stated = Stated(geometries, pitch_px, angle_deg, grid)

    def fitted(bad: NDArray[np.bool_]) -> tuple[NDArray[np.float64], LatticeFit | None]:
        image = np.where(bad, _median_of_good(raw, bad), raw)
        fit = None
        if grid is None:
            fit = best_fit(image, geometries, pitch_range_px, illuminated_fraction, circle)
        if circle is not None or (fit is not None and fit.is_certain):
            return image, fit
        few = few_spots(image, stated)
        return image, fit if few is None or (fit is not None and fit.is_better(few)) else few

    image, fit = fitted(bad[part.slices] | hot)
    if fit is not None and (on_lattice := _hot_on_lattice(hot, fit)).any():
        sharp = fitted((bad[part.slices] | hot) & ~on_lattice)[1]
        if sharp is not None and sharp.lit >= fit.lit:
            fit, hot = sharp, hot & ~on_lattice
    if fit is None:
        raise InputError(_nothing_found(image, pitch_range_px, geometry))
    lattice, spots, illuminated = fit.lattice, fit.spots, fit.illuminated
    cells = spots.cells[illuminated.nodes]
    if not fit.is_sensor:
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
        elsewhere=as_rows(np.concatenate([fit.elsewhere, fit.dim, _lost_as_hot(raw, hot, fit)]) + corner),
        doubt=illuminated.doubt,
    )


def _pitch_range(pitch_px: float | None, shape: tuple[int, ...]) -> tuple[float, float]:
    """Return the smallest and largest pitch to try: two rows must fit into the frame."""
    largest = min(shape) / 1.6
    if pitch_px is None:
        return SMALLEST_PITCH_PX, largest
    if not _SMALLEST_GIVEN_PITCH_PX <= number_between("pitch_px", pitch_px) <= largest:
        raise InputError(
            f"expected {_SMALLEST_GIVEN_PITCH_PX} to {largest:g}: two rows of lenslets must fit in; "
            "of quad cells, --grid of faintspot layout gives the places",
            name="pitch_px",
            value=pitch_px,
        )
    return 0.8 * pitch_px, 1.2 * pitch_px


def _nothing_found(image: NDArray[np.float64], pitch_range_px: tuple[float, float], geometry: str) -> str:
    """Return a one-line message that no lattice was found, with the range searched and what to try."""
    if np.ptp(image) == 0:
        return f"frame: every pixel is {image.flat[0]:g}, expected an image of lenslet spots"
    kind = "square or hexagonal" if geometry == "auto" else geometry
    return (
        f"frame: found no {kind} lattice of spots with a pitch of {pitch_range_px[0]:.1f} to "
        f"{pitch_range_px[1]:.1f} px above the noise; average more frames, or state the pitch or bad pixels; "
        + _KNOWN
    )


def _too_few(count: int, lattice: Lattice, pupil: PupilRegion | None) -> str:
    """Return a one-line message that a lattice has too few illuminated lenslets."""
    found = f"frame: a {lattice.geometry} lattice with a pitch of {lattice.pitch_px:.1f} px fits best, but "
    expected = "expected at least two rows of two"
    if pupil is not None:
        return f"{found}{count} of its lenslets lie in the pupil given, {expected}"
    return (
        f"{found}only {count} of its lenslets are lit for certain, {expected}; average more frames, or state "
        f"the pitch; {_KNOWN}"
    )


def _checked(frame: object, bad_pixels: object) -> tuple[NDArray[np.generic], NDArray[np.bool_]]:
    """Return frame or frames and a mask of bad pixels, where the frame may be NaN."""
    frames = real_array("frame", frame, minimum_dimensions=2)
    check_shape("frame", frames, ("ny", "nx"), ("n_frames", "ny", "nx"))
    bad = np.zeros(frames.shape[-2:], dtype=bool)
    if bad_pixels is not None:
        bad = real_array("bad_pixels", bad_pixels) != 0
        check_shape("bad_pixels", bad, frames.shape[-2:])
    return frames, bad


def _mean_image(frames: NDArray[Any], bad: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the mean frame, float64, with bad pixels replaced by the median around them."""
    if min(frames.shape[-2:]) < 2 * SMALLEST_PITCH_PX:
        raise InputError(
            f"frame: expected at least 10 x 10 pixels, got shape {frames.shape}; --grid 1x1 of faintspot "
            "layout is for a quad cell"
        )
    if bad.mean() > 0.5:
        raise InputError(
            f"bad_pixels: {bad.sum()} of {bad.size} pixels are bad, expected at most half; good ones are 0"
        )
    if bad.any():
        frames = np.where(bad, np.median(frames[..., ~bad]).astype(frames.dtype), frames)
    return _robust_mean(finite_array("frame", frames))


def _hot_on_lattice(hot: NDArray[np.bool_], fit: LatticeFit) -> NDArray[np.bool_]:
    """Return the hot pixels near nodes of a lattice, if there are so many that they must be sharp spots.

    Hot pixels are anywhere. Spots below 1 px look like them where the background is cut off at 0.
    """
    y, x = np.nonzero(hot)
    expected = fit.lattice.positions(fit.spots.cells) + fit.spots.drifts
    distance = as_tree(expected).query(as_rows(x + 1j * y))[0]
    near = distance < _ON_NODE * fit.lattice.pitch_px
    by_chance = np.pi * _ON_NODE**2 / (1.0 if fit.lattice.geometry == "square" else np.sqrt(0.75))
    surplus = np.count_nonzero(near) - by_chance * len(x)
    spots = np.zeros_like(hot)
    significant = surplus > _BEYOND_CHANCE * np.sqrt(max(by_chance * len(x), 1.0))
    if significant and surplus > _MOSTLY * np.count_nonzero(near):
        spots[y[near], x[near]] = True
    return spots


def _lost_as_hot(
    image: NDArray[np.float64], hot: NDArray[np.bool_], fit: LatticeFit
) -> NDArray[np.complex128]:
    """Return the hot pixels that may be the spots of dark lenslets beside lit ones."""
    y, x = np.nonzero(hot & (image > np.median(image) + _PEAK * fit.illuminated.least_flux))
    lit, pitch_px = fit.illuminated.nodes, fit.lattice.pitch_px
    expected = fit.lattice.positions(fit.spots.cells) + fit.spots.drifts
    distance, nearest = as_tree(expected).query(as_rows(x + 1j * y))
    beside = as_tree(expected[lit]).query(as_rows(expected))[0] < _BESIDE * pitch_px
    return np.asarray((x + 1j * y)[(distance < _ON_NODE * pitch_px) & (beside & ~lit)[nearest]])


def _robust_mean(frames: NDArray[np.generic]) -> NDArray[np.float64]:
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
