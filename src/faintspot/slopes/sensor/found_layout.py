"""Layout found in a frame, with the lenslets and spots left out and the doubtful spots."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from faintspot.slopes.kernels.driver.doubtful import Expected, flag_doubtful
from faintspot.slopes.sensor.binning import magnified_layout, scaled_points
from faintspot.slopes.sensor.detection.lenslets import LensletGrid
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.sensor.neighbours import LEAST_DIFFERENCE, lines_of, neighbours_of
from faintspot.slopes.sensor.windows import Windows, find_windows

_GHOST, _DARK = 0.3, 0.25  # of the median flux of the neighbours, and of all


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
        x, y of the bright spots outside all windows that belong to none of these lenslets [px].
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
    depth = _depth(found, grid.spots, np.arange(len(grid.spots)))[within]
    return FoundLayout(
        Layout.of_windows(found),
        grid,
        grid.centres[~within],
        _outside(found),
        depth < max(grid.spot_px, 1.0),
        (_unlike(grid) | _dim(grid))[within],
    )


def _depth(found: Windows, spots: NDArray[np.float64], of_window: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the distance [px] of each spot inside the edge of its window; negative outside."""
    side = np.array(found.window[::-1])
    from_first = spots - found.corners[of_window, ::-1] + 0.5
    return np.asarray(np.minimum(from_first, side - from_first).min(axis=-1))


def _outside(found: Windows) -> NDArray[np.float64]:
    """Return the bright spots outside all windows, including windows cut by the edge of the frame."""
    spots = found.lenslets.elsewhere
    if len(spots) == 0:
        return spots
    middles = found.corners[:, ::-1] + 0.5 * (np.array(found.window[::-1]) - 1)
    _, near = cKDTree(middles).query(spots, min(4, len(middles)), p=np.inf)
    near = near.reshape(len(spots), -1)
    return np.asarray(spots[(_depth(found, spots[:, None], near) < 0).all(axis=1)])


def _unlike(grid: LensletGrid) -> NDArray[np.bool_]:
    """Return which spots have displacements that differ from those of all (at least two) neighbours."""
    x, y = np.asarray(grid.spots - grid.centres - grid.drifts, np.float32).T
    n = len(x)
    flags = np.zeros((1, n), np.uint8)
    expected = Expected(
        np.zeros((2, n), np.float32),
        np.full((2, n), np.inf, np.float32),
        *lines_of(neighbours_of(grid.cells, grid.geometry, diagonal=True)),
        np.zeros((n, 0, 2), np.int64),
        np.float32(LEAST_DIFFERENCE * grid.pitch_px),
    )
    x, y = np.ascontiguousarray(x[None]), np.ascontiguousarray(y[None])
    flag_doubtful(x, y, np.zeros_like(x), flags, expected, np.empty(n, np.float32))
    return np.asarray(flags[0] != 0)


def _dim(grid: LensletGrid) -> NDArray[np.bool_]:
    """Return which spots amid others are so dim that they may be ghosts in a dark lenslet."""
    around = np.append(grid.flux, np.nan)[neighbours_of(grid.cells, grid.geometry)]
    around[np.isnan(around).all(axis=1)] = 0.0
    brightest = np.maximum(_GHOST * np.nanmedian(around, axis=1), _DARK * np.median(grid.flux))
    return np.asarray(grid.flux < brightest)
