"""Layout found in a frame, with the lenslets and spots left out and the doubtful spots."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import number_between
from faintspot.base.errors import InputError
from faintspot.base.statistics import mad_std
from faintspot.slopes.kernels.host import lanes_for
from faintspot.slopes.kernels.validity.doubtful import Expected, doubtful_scratch_size, flag_doubtful
from faintspot.slopes.sensor.binning import magnified_layout, scaled_points
from faintspot.slopes.sensor.detection.fits import MOST
from faintspot.slopes.sensor.detection.lenslets import LensletGrid
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.sensor.region import LEAST_DIFFERENCE, PupilRegion, Rectangle, lines_of, neighbours_of
from faintspot.slopes.sensor.window_checks import LARGEST_WINDOW, SMALLEST_WINDOW, window_size
from faintspot.slopes.sensor.windows import find_windows

_GHOST = 0.3  # of the median flux of the neighbours
_MOST_NAMED = 12  # sub-apertures in a doubt
_EDGE_GHOST = 0.2  # of that of the neighbours at the edge of the pupil, where lenslets may be partly lit


@dataclass(frozen=True)
class FoundLayout:
    """Layout found in a frame, with the lenslets and spots left out and the doubtful spots.

    Parameters
    ----------
    layout : Layout
        Illuminated sub-apertures whose windows are within the frame.
    lenslets : LensletGrid
        All illuminated lenslets, including those at the edge.
    cut : (n, 2) array
        x, y of the illuminated lenslets omitted because their window leaves the frame [px].
    outside : (n, 2) array
        x, y of the spots outside all windows that belong to none of these lenslets [px]: bright ones, and dim
        ones whose position has a standard error below 0.1 px.
    clipped : (n_subapertures,) array of bool
        True where the spot is within its standard deviation (at least 1 px) of the edge of its window.
    unlike : (n_subapertures,) array of bool
        True where the spot is displaced unlike all its neighbours, or amid others with four times its flux.
    """

    layout: Layout
    lenslets: LensletGrid
    cut: NDArray[np.float64]
    outside: NDArray[np.float64]
    clipped: NDArray[np.bool_]
    unlike: NDArray[np.bool_]

    def __getitem__(self, chosen: NDArray[np.bool_]) -> FoundLayout:
        """Return the result for the chosen (n_subapertures,) sub-apertures only."""
        return replace(
            self, layout=self.layout[chosen], clipped=self.clipped[chosen], unlike=self.unlike[chosen]
        )

    @property
    def doubts(self) -> tuple[str, ...]:
        """Doubts about the layout, one sentence each."""
        doubts = [self.lenslets.doubt] if self.lenslets.doubt else []
        for reason, doubtful in (
            ("at their window's edge, which cuts them", self.clipped),
            ("displaced unlike those of all neighbours, or far dimmer", self.unlike),
        ):
            if doubtful.any():
                numbers = np.flatnonzero(doubtful)
                more = ", ..." if len(numbers) > _MOST_NAMED else ""
                named = ", ".join(map(str, numbers[:_MOST_NAMED])) + more
                doubts.append(f"slopes of {named} ({len(numbers)}): spots {reason}")
        return tuple(doubts)

    def magnified(self, factor: int, frame_shape: tuple[int, int]) -> FoundLayout:
        """Return what was found in a binned frame in the pixels of the camera, of frames of `frame_shape`."""
        grid = self.lenslets
        lenslets = replace(
            grid,
            pitch_px=grid.pitch_px * factor,
            centres=scaled_points(grid.centres, factor),
            drifts=grid.drifts * factor,
            spots=scaled_points(grid.spots, factor),
            spot_px=grid.spot_px * factor,
            elsewhere=scaled_points(grid.elsewhere, factor),
        )
        return replace(
            self,
            layout=magnified_layout(self.layout, factor, frame_shape),
            lenslets=lenslets,
            cut=scaled_points(self.cut, factor),
            outside=scaled_points(self.outside, factor),
        )


def find_layout(frame: ArrayLike, **options: Any) -> FoundLayout:
    """Find the sub-apertures of a frame and list those left out; see `Layout.from_frame`.

    Raises
    ------
    InputError
        If no regular array of spots is found, or no window is within the frame.
    """
    found = find_windows(frame, **options)
    grid, within = found.lenslets, found.within
    depth = found.depth(grid.spots, np.arange(len(grid.spots)))[within]
    return FoundLayout(
        Layout.of_windows(found),
        grid,
        grid.centres[~within],
        found.outside,
        depth < max(grid.spot_px, 1.0),
        (_unlike(grid) | _dim(grid))[within],
    )


def _unlike(grid: LensletGrid) -> NDArray[np.bool_]:
    """Return which spots have displacements that differ from those of all (at least two) neighbours."""
    x, y = np.asarray(grid.spots - grid.centres - grid.drifts, np.float32).T
    n = len(x)
    flags = np.zeros((1, n), np.uint8)
    lanes = lanes_for(np.float32)
    expected = Expected(
        lanes,
        np.zeros((2, n), np.float32),
        np.full((2, n), np.inf, np.float32),
        *lines_of(neighbours_of(grid.cells, grid.geometry, diagonal=True), lanes.width),
        np.zeros((n, 0, 2), np.int64),
        np.float32(LEAST_DIFFERENCE * grid.pitch_px),
    )
    x, y = np.ascontiguousarray(x[None]), np.ascontiguousarray(y[None])
    flag_doubtful(x, y, np.zeros_like(x), flags, expected, np.empty(doubtful_scratch_size(n), np.float32))
    return np.asarray(flags[0] != 0)


def _dim(grid: LensletGrid) -> NDArray[np.bool_]:
    """Return which spots amid others are so dim that they may be ghosts in a dark lenslet."""
    around = np.append(grid.flux, np.nan)[neighbours_of(grid.cells, grid.geometry)]
    is_edge = np.isnan(around).any(axis=1)
    around[np.isnan(around).all(axis=1)] = 0.0
    near = np.nanmedian(around, axis=1)
    return np.asarray(grid.flux < np.where(is_edge, _EDGE_GHOST, _GHOST) * near)


_CENTRED = 0.3  # of a cell: largest distance of a spot from its middle
_LIT_FRACTION = 0.3
_BRIGHT = 0.95  # quantile of the flux, relative to which cells are selected for the median
_CLOSE, _DOUBTFUL = 1.25, 0.05
_NOISY = 0.2  # standard deviation of the flux of the dark cells, in units of the median of the others
# Without a dark level, dim cells are dark if the bright ones exceed them by this many of their standard
# deviations. With fewer cells or a smaller difference, as in 5 % of vignetted grids, both may be illuminated.
_APART, _FEWEST = 8.0, 36


@dataclass(frozen=True)
class KnownGrid:
    """Illuminated sub-apertures of a grid at a known position.

    Parameters
    ----------
    layout : Layout
        Illuminated sub-apertures.
    unlit : (n, ny, nx) array
        Images of the other sub-apertures.
    doubt : str
        Reason why the choice may be wrong, in one line; empty if it is clear.
    """

    layout: Layout
    unlit: NDArray[np.float64]
    doubt: str

    def __getitem__(self, chosen: NDArray[np.bool_]) -> KnownGrid:
        """Return the result for the chosen (n_subapertures,) sub-apertures only."""
        return replace(self, layout=self.layout[chosen])

    @property
    def doubts(self) -> tuple[str, ...]:
        """The doubt, if there is one."""
        return (self.doubt,) if self.doubt else ()

    def magnified(self, factor: int, frame_shape: tuple[int, int]) -> KnownGrid:
        """Return the grid of a binned frame in the pixels of the camera, of frames of `frame_shape`."""
        layout = magnified_layout(self.layout, factor, frame_shape)
        return replace(self, layout=layout, unlit=self.unlit / factor**2)


def find_grid(
    frame: NDArray[np.float64], shape: tuple[int, int], has_dark: bool, options: dict[str, Any]
) -> FoundLayout | KnownGrid:
    """Find a grid of which rows and columns are known: its spots, or cells that fill the frame.

    Up to 4 x 4 spots may be anywhere, unless a pupil is stated or they are in such cells.

    Parameters
    ----------
    frame : (h, w) array
        Mean of the frames; NaN for bad pixels.
    shape : (int, int)
    has_dark : bool
    options : dict
        Options of `find_layout`. Those that `find_illuminated` does not have are for spots anywhere.
    """
    filling = {name: options.get(name) for name in ("pixels", "illuminated_fraction", "pupil", "roi")}
    if max(shape) > MOST or filling["pupil"] is not None:
        return find_illuminated(frame, shape, has_dark=has_dark, **filling)
    try:
        found = find_layout(np.nan_to_num(frame), **options)
    except InputError:
        if any(options.get(name) is not None for name in ("pitch_px", "angle_deg", "centre")):
            raise
        return find_illuminated(frame, shape, has_dark=has_dark, **filling)
    part = Rectangle.given(filling["roi"], frame.shape)
    pitch = np.array([part.x1 - part.x0, part.y1 - part.y0]) / shape[::-1]
    place = (found.lenslets.spots - (part.x0, part.y0) + 0.5) / pitch
    fills = np.abs(place % 1 - 0.5).max() < _CENTRED and len(np.unique(place // 1, axis=0)) == len(place)
    if fills and (shape == (1, 1) or found.lenslets.pitch_px > (1 - _CENTRED) * pitch.min()):
        return find_illuminated(frame, shape, has_dark=has_dark, **filling)
    return found


def find_illuminated(
    frame: NDArray[np.float64],
    shape: tuple[int, int],
    *,
    pixels: int | tuple[int, int] | None = None,
    has_dark: bool = False,
    illuminated_fraction: float | None = None,
    pupil: object = None,
    roi: object = None,
) -> KnownGrid:
    """Find the illuminated sub-apertures of a grid that fills a frame, from their flux.

    Parameters
    ----------
    frame : (h, w) array
        Mean of the frames; NaN for bad pixels.
    shape : (int, int)
        Rows and columns of cells, which fill the frame or `roi`.
    pixels : int or (int, int), optional
        Window at the centre of each cell. Default: all its whole pixels, at most 64.
    has_dark : bool
        Whether the dark level is subtracted. Otherwise the flux of the dimmest cells is taken to be 0, if
        they are clearly separated from the bright ones.
    illuminated_fraction : float, optional
        Smallest flux of an illuminated cell, relative to the median of the bright ones. Default: 0.3.
    pupil : (x, y, radius) or (x, y, radius, inner radius), optional
        Use the cells whose centres are in this disk or annulus [px], whatever their flux.
    roi : (x0, y0, x1, y1), optional
        Columns x0 to x1 - 1 and rows y0 to y1 - 1 that the grid fills.

    Raises
    ------
    InputError
        If the grid does not fit into the frame, or no cell is illuminated.
    """
    grid = _whole_grid(frame.shape, shape, pixels, roi)
    images = grid.images(frame)
    flux = np.nan_to_num(np.nanmean(images.reshape(len(grid), -1), axis=1)) * grid.pixels
    if pupil is not None:
        illuminated, doubt = PupilRegion.given(pupil).holds(grid.centres.view(np.complex128)[:, 0]), ""
    else:
        fraction = _LIT_FRACTION if illuminated_fraction is None else illuminated_fraction
        illuminated, doubt = _illuminated(
            flux, number_between("illuminated_fraction", fraction, 0.0, 1.0), has_dark
        )
    if not illuminated.any():
        raise InputError(
            f"grid of {shape[0]} x {shape[1]}: no cell is illuminated, or none is in the pupil; check "
            "frame and dark"
        )
    return KnownGrid(grid[illuminated], images[~illuminated], doubt)


def _whole_grid(
    frame_shape: tuple[int, ...], shape: tuple[int, int], pixels: int | tuple[int, int] | None, roi: object
) -> Layout:
    """Return the layout of all cells."""
    part = Rectangle.given(roi, frame_shape)
    size = np.array([part.y1 - part.y0, part.x1 - part.x0])
    pitch = size / shape
    largest = np.minimum(np.floor(pitch), LARGEST_WINDOW).astype(int)
    if largest.min() < SMALLEST_WINDOW:
        raise InputError(
            f"grid of {shape[0]} x {shape[1]} in {size[0]} x {size[1]} pixels: expected cells of at least "
            f"{SMALLEST_WINDOW} x {SMALLEST_WINDOW} pixels, got {pitch[0]:.3g} x {pitch[1]:.3g}"
        )
    window = (int(largest[0]), int(largest[1])) if pixels is None else window_size("pixels", pixels)
    if np.any(np.array(window) > pitch):
        raise InputError(
            f"pixels = {window[0]} x {window[1]}: expected a window within a cell of {pitch[0]:.4g} x "
            f"{pitch[1]:.4g} pixels"
        )
    cells = np.argwhere(np.ones(shape, dtype=bool))
    middles = np.array([part.y0, part.x0]) + (cells + 0.5) * pitch - 0.5
    corners = np.floor(middles - 0.5 * np.array(window) + 1.0).astype(np.int64)
    frame = (int(frame_shape[0]), int(frame_shape[1]))
    return Layout(frame, window, corners, middles[:, ::-1], cells, pitch_px=float(pitch.min()))


def _illuminated(flux: NDArray[np.float64], fraction: float, has_dark: bool) -> tuple[NDArray[np.bool_], str]:
    """Return which cells are illuminated, and the reason why that may be wrong."""
    if len(flux) == 1:
        return np.ones(1, dtype=bool), ""
    background = 0.0 if has_dark else _dark_level(flux)
    if np.isnan(background):
        doubt = "no cell is clearly dark, all are used; give --dark or --pupil to select them"
        return np.ones(len(flux), dtype=bool), doubt
    above = flux - background
    bright = float(np.quantile(above, _BRIGHT))
    if bright <= 0:
        return np.zeros(len(flux), dtype=bool), ""
    relative = above / np.median(above[above >= fraction * bright])
    illuminated = relative >= fraction
    close = np.count_nonzero((relative > fraction / _CLOSE) & (relative < fraction * _CLOSE))
    if not illuminated.all() and np.std(relative[~illuminated]) > _NOISY:
        return (
            illuminated,
            "the flux of the dark cells scatters almost as much as that of the others; average more frames",
        )
    if close > max(1, _DOUBTFUL * np.count_nonzero(illuminated)):
        return (
            illuminated,
            f"{close} cells have about {fraction:.2g} of the median flux, the illumination limit",
        )
    return illuminated, ""


def _dark_level(flux: NDArray[np.float64]) -> float:
    """Return the median of the dim cells (split after Otsu 1979); NaN if they may be illuminated, too."""
    if len(flux) < _FEWEST:
        return np.nan
    ordered = np.sort(flux)
    number = np.arange(1, len(flux))
    lower = np.cumsum(ordered)[:-1]
    between = (ordered.sum() * number / len(flux) - lower) ** 2 / (number * (len(flux) - number))
    split = int(np.argmax(between)) + 1
    level = float(np.median(ordered[:split]))
    apart = float(np.median(ordered[split:])) - level
    is_apart = apart > _APART * mad_std(ordered[:split])
    return level if min(split, len(flux) - split) >= 4 and is_apart else np.nan
