"""A layout found in a frame, what was left out of it, and which of its spots are doubtful."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from faintspot.sensor.layout import Layout
from faintspot.sensor.lenslets import LensletGrid
from faintspot.sensor.windows import Windows, find_windows

# A spot is unlike its neighbours when its displacement differs from each of theirs by so many pitches, and by
# so many times the median of that difference.
_UNLIKE, _TYPICAL = 0.2, 4.0


@dataclass(frozen=True)
class FoundLayout:
    """A layout found in a frame, what was left out of it, and which of its spots are doubtful.

    Parameters
    ----------
    layout : Layout
        The lit sub-apertures whose windows lie within the frame.
    lenslets : LensletGrid
        All lit lenslets, those at the edge too.
    cut : (n, 2) array
        x, y of the lit lenslets that were left out because their window leaves the frame, px.
    outside : (n, 2) array
        x, y of the bright spots that lie outside all windows and belong to none of these lenslets, px.
    clipped : (n_subapertures,) array of bool
        True where the spot lies within its standard deviation (at least 1 px) of its window's edge.
    unlike : (n_subapertures,) array of bool
        True where the spot is displaced unlike those of all its neighbours.
    """

    layout: Layout
    lenslets: LensletGrid
    cut: NDArray[np.float64]
    outside: NDArray[np.float64]
    clipped: NDArray[np.bool_]
    unlike: NDArray[np.bool_]

    def __getitem__(self, chosen: NDArray[np.bool_]) -> FoundLayout:
        """Return it with only the chosen (n_subapertures,) sub-apertures."""
        return replace(
            self, layout=self.layout[chosen], clipped=self.clipped[chosen], unlike=self.unlike[chosen]
        )


def find_layout(frame: ArrayLike, **options: Any) -> FoundLayout:
    """Find the sub-apertures of a frame, and say which were left out; see `Layout.from_frame`.

    Raises
    ------
    InputError
        When no regular array of spots is found, or no window lies within the frame.
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
        _unlike(grid)[within],
    )


def _depth(found: Windows, spots: NDArray[np.float64], of_window: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return how far (px) each spot lies inside the edge of the given window; negative outside."""
    side = np.array(found.window[::-1])
    from_first = spots - found.corners[of_window, ::-1] + 0.5
    return np.asarray(np.minimum(from_first, side - from_first).min(axis=-1))


def _outside(found: Windows) -> NDArray[np.float64]:
    """Return the bright spots that no window, in the frame or cut by its edge, has inside."""
    spots = found.lenslets.elsewhere
    if len(spots) == 0:
        return spots
    middles = found.corners[:, ::-1] + 0.5 * (np.array(found.window[::-1]) - 1)
    _, near = cKDTree(middles).query(spots, min(4, len(middles)), p=np.inf)
    near = near.reshape(len(spots), -1)
    return np.asarray(spots[(_depth(found, spots[:, None], near) < 0).all(axis=1)])


def _unlike(grid: LensletGrid) -> NDArray[np.bool_]:
    """Return which spots are displaced unlike those of all their neighbours (two at least)."""
    shifts = grid.spots - grid.centres - grid.drifts
    near, neighbour = cKDTree(grid.centres).query(
        grid.centres, min(9, len(shifts)), distance_upper_bound=1.6 * grid.pitch_px
    )
    known = np.isfinite(near)
    known[:, 0] = False
    differences = np.linalg.norm(shifts[np.where(known, neighbour, 0)] - shifts[:, None], axis=-1)
    least = np.where(known, differences, np.inf).min(axis=1)
    several = known.sum(axis=1) >= 2
    usual = float(np.median(least[several])) if several.any() else 0.0
    return np.asarray(several & (least > max(_UNLIKE * grid.pitch_px, _TYPICAL * usual)))
