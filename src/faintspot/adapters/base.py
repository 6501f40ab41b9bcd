"""What all adapters share: a tool's lenslets to a layout, a tool's image to slopes in its own unit."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.checks import finite_array
from faintspot.errors import InputError
from faintspot.pipeline import SlopePipeline
from faintspot.sensor.layout import Layout
from faintspot.sensor.window_size import LARGEST_WINDOW, SMALLEST_WINDOW
from faintspot.slopes import Slopes

_EXACT_PX = 1e-6  # what a centre in pixels may be off by rounding


def largest_window(centres: ArrayLike) -> int:
    """Return the side of the largest square windows around lenslets that do not overlap, pixels.

    Parameters
    ----------
    centres : (n, 2) array
        x, y of every lenslet's centre, px.

    Raises
    ------
    InputError
        When there are fewer than two lenslets, or they are closer than the smallest window is wide.
    """
    from scipy.spatial import cKDTree

    array = finite_array("lenslet centres", centres, minimum_dimensions=2)
    if len(array) < 2:
        raise InputError("pixels: expected the window's side, as one lenslet does not tell it, got none")
    apart = float(np.min(cKDTree(array).query(array, k=2, p=np.inf)[0][:, 1]))
    side = int(np.floor(apart + _EXACT_PX))
    if side < SMALLEST_WINDOW:
        raise InputError(f"lenslets: expected at least {SMALLEST_WINDOW} px between centres, got {apart:.3g}")
    return min(side, LARGEST_WINDOW)


def window_corners(centres: ArrayLike, side: int) -> NDArray[np.int64]:
    """Return row and column of the first pixel of the window of `side` pixels nearest each centre: (n, 2).

    Windows are whole pixels, centres need not be: what is left over is in `Layout.offsets`.
    """
    array = np.round(finite_array("lenslet centres", centres, minimum_dimensions=2), 6)
    return np.floor(array[:, ::-1] - 0.5 * (side - 1) + 0.5).astype(np.int64)


def on_detector(centres: ArrayLike, frame_shape: tuple[int, int], side: int) -> NDArray[np.bool_]:
    """Say of each lenslet whether its whole window is on the detector: (n,) bool."""
    corners = window_corners(centres, side)
    return np.all((corners >= 0) & (corners + side <= np.array(frame_shape)), axis=1)  # type: ignore[no-any-return]


def layout_around(centres: ArrayLike, frame_shape: tuple[int, int], side: int) -> Layout:
    """Return the layout of windows around lenslets.

    Parameters
    ----------
    centres : (n, 2) array
        x, y of each lenslet's centre in frame pixels (pixel i has its centre at i). Positions are measured
        from there, also where that is not the middle of a window.
    frame_shape : (int, int)
        Height and width of a frame.
    side : int
        Of each window, pixels.

    Raises
    ------
    InputError
        As for `Layout`.
    """
    corners = window_corners(centres, side)
    return Layout(frame_shape, (side, side), corners, finite_array("lenslet centres", centres))


class UnitAdapter:
    """A pipeline whose slopes are in another tool's unit; it remembers its last measurement.

    Parameters
    ----------
    pipeline : SlopePipeline
    unit_per_px : (2,) array
        The tool's unit per pixel along x and y; negative where its axis runs against the frame's.
    """

    def __init__(self, pipeline: SlopePipeline, unit_per_px: ArrayLike) -> None:
        self.pipeline = pipeline
        self.unit_per_px = finite_array("unit_per_px", unit_per_px).astype(np.float64).reshape(2, 1)
        self._last: Slopes | None = None

    def measure(self, frame: Any) -> NDArray[np.float64]:
        """Return x and y slopes of a frame (h, w) in the tool's unit: (2, n).

        Raises
        ------
        InputError
            As for the pipeline.
        """
        self._last = self.pipeline(frame)
        return np.stack([self._last.x, self._last.y], dtype=np.float64) * self.unit_per_px

    @property
    def last(self) -> Slopes:
        """The last measurement, in pixels, with flags and flux.

        Raises
        ------
        InputError
            When nothing was measured yet.
        """
        if self._last is None:
            raise InputError("last slopes: expected an image to be measured first, got none")
        return self._last

    @property
    def standard_errors(self) -> NDArray[np.float64]:
        """Standard errors of the last slopes in the tool's unit, (2, n); infinite where not known."""
        in_px = np.stack([self.last.standard_error_x, self.last.standard_error_y], dtype=np.float64)
        return in_px * np.abs(self.unit_per_px)
