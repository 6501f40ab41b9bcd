"""Windows around the lenslets found in a frame: size and position."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from faintspot.base.errors import InputError
from faintspot.slopes.sensor.detection.lenslets import LensletGrid, find_lenslets
from faintspot.slopes.sensor.window_checks import LARGEST_WINDOW, window_size, with_stated

# Windows may be moved this far from their spots to be a pixel larger: no more than the rounding of their
# corners to whole pixels.
_SPREAD_PX = 0.5
_LARGEST_SHIFT = 0.35  # of a window's side, by which `move_windows` may shift windows off their spots


@dataclass(frozen=True, eq=False)
class Windows:
    """Windows of the lenslets found in a frame.

    Parameters
    ----------
    frame_shape, window : (int, int)
    corners : (n, 2) array of int
        Row and column of the first pixel of each window.
    within : (n,) array of bool
        Whether the window is within the frame.
    lenslets : LensletGrid
        All illuminated lenslets, including those at the edge.
    """

    frame_shape: tuple[int, int]
    window: tuple[int, int]
    corners: NDArray[np.int64]
    within: NDArray[np.bool_]
    lenslets: LensletGrid
    fitted: tuple[str, ...]
    """Parameters of the lattice that were fitted to the frame: "centre", "pitch", "angle"."""

    def depth(self, spots: NDArray[np.float64], of_window: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the distance [px] of each spot inside the edge of its window; negative outside."""
        side = np.array(self.window[::-1])
        from_first = spots - self.corners[of_window, ::-1] + 0.5
        return np.asarray(np.minimum(from_first, side - from_first).min(axis=-1))

    @property
    def outside(self) -> NDArray[np.float64]:
        """Lit spots (m, 2) outside all windows, including windows cut by the edge of the frame."""
        spots = self.lenslets.elsewhere
        if len(spots) == 0:
            return spots
        middles = self.corners[:, ::-1] + 0.5 * (np.array(self.window[::-1]) - 1)
        _, near = scipy.spatial.cKDTree(middles).query(spots, min(4, len(middles)), p=np.inf)
        near = near.reshape(len(spots), -1)
        return np.asarray(spots[(self.depth(spots[:, None], near) < 0).all(axis=1)])


def find_windows(
    frame: ArrayLike,
    *,
    pixels: int | tuple[int, int] | None = None,
    move_windows: bool = False,
    pitch_px: float | None = None,
    angle_deg: float | None = None,
    centre: object = None,
    fit: Sequence[str] = (),
    **options: Any,
) -> Windows:
    """Find the lenslets of a frame, and a window for each.

    Parameters
    ----------
    frame : (h, w) or (n, h, w) array
    pixels : int or (int, int), optional
        Window, see `faintspot.Layout.from_frame`.
    move_windows : bool
        Whether all windows may be shifted off the spots to include those at the edge of the frame.
    pitch_px, angle_deg, centre, fit
        What is known of the lattice, see `faintspot.slopes.sensor.window_checks.with_stated`.
    **options
        Passed on to `faintspot.slopes.sensor.detection.lenslets.find_lenslets`.

    Raises
    ------
    InputError
        If no regular array of spots is found, or no window is within the frame.
    """
    window = None if pixels is None else window_size("pixels", pixels)
    found = find_lenslets(frame, pitch_px=pitch_px, angle_deg=angle_deg, **options)
    grid, fitted = with_stated(found, pitch_px=pitch_px, angle_deg=angle_deg, centre=centre, fit=fit)
    height, width = np.shape(frame)[-2:]
    shape = (height, width)
    middles = (grid.centres + grid.drifts)[:, ::-1]
    if window is None:
        window = _largest_window(middles, grid.pitch_px)
    middles = _spread(middles, window)
    if move_windows:
        moved = [_shift_inside(middles[:, i], window[i], shape[i]) for i in range(2)]
        middles = np.stack(moved, axis=1)
    corners = np.floor(middles - 0.5 * (np.array(window) - 1) + 0.5).astype(np.int64)
    within = np.all((corners >= 0) & (corners + np.array(window) <= np.array(shape)), axis=1)
    if not within.any():
        raise InputError(
            f"frame: the windows of all {len(corners)} lenslets found leave the frame; "
            f"try pixels < {min(window)}"
        )
    return Windows(shape, window, corners, within, grid, fitted)


def _largest_window(middles: NDArray[np.float64], pitch_px: float) -> tuple[int, int]:
    """Return the largest square window without overlap, with windows moved by at most half a pixel."""
    distances = np.asarray(scipy.spatial.cKDTree(middles).query(middles, k=2, p=np.inf)[0])[:, 1]
    clear = float(np.min(distances[np.isfinite(distances)], initial=pitch_px))
    side = int(np.rint(clear))
    if (side / clear - 1) * _half_extent(middles) > _SPREAD_PX:
        side = int(clear)
    side = min(side, LARGEST_WINDOW)
    return side, side


def _half_extent(middles: NDArray[np.float64]) -> float:
    return float(np.max(np.ptp(middles, axis=0))) / 2


def _spread(middles: NDArray[np.float64], window: tuple[int, int]) -> NDArray[np.float64]:
    """Return window centres far enough apart for the window, if half a pixel is sufficient.

    Centres at least a window apart keep that distance when rounded to whole pixels.
    """
    pairs = scipy.spatial.cKDTree(middles).query_pairs(max(window), p=np.inf, output_type="ndarray")
    apart = np.abs(middles[pairs[:, 0]] - middles[pairs[:, 1]]) / np.array(window)
    closest = float(np.min(apart.max(axis=1), initial=1.0))
    if closest >= 1 or (1 / closest - 1) * _half_extent(middles) > _SPREAD_PX:
        return middles
    middle = (middles.min(axis=0) + middles.max(axis=0)) / 2
    return np.asarray(middle + (middles - middle) * ((1 + 1e-9) / closest))


def _shift_inside(centres: NDArray[np.float64], side: int, length: int) -> NDArray[np.float64]:
    """Shift all windows along one axis, by the smallest shift that includes the most at the edge."""
    shifts = np.arange(-_LARGEST_SHIFT * side, _LARGEST_SHIFT * side + 0.25, 0.5)
    starts = np.floor(centres + shifts[:, None] - 0.5 * (side - 1) + 0.5)
    inside = np.count_nonzero((starts >= 0) & (starts + side <= length), axis=1)
    unmoved = np.floor(centres - 0.5 * (side - 1) + 0.5)
    if inside.max() <= np.count_nonzero((unmoved >= 0) & (unmoved + side <= length)):
        return centres
    return np.asarray(centres + shifts[np.lexsort((np.abs(shifts), -inside))[0]])
