"""Test whether sub-apertures have any flux: its limits for a sensor, and the test of mean images."""

from __future__ import annotations

import math
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from faintspot.slopes.kernels.compilation.host import WIDTHS, lanes_for
from faintspot.slopes.kernels.driver.dark import LightTest, scratch_size, significances
from faintspot.slopes.sensor.layout import Layout

FALSE_LIGHT = 1e-3
"""Probability that a window without any flux passes."""
_FEWEST_PX = 4  # of a window's side: below, as in quad cells, nothing in it is far from the spot
_LEAST_BOX_PX = 3
_BOX_OF_FWHM = 1.25  # of a Gaussian spot in white noise: nearly the most significant box
_BOXES = 8.0  # independent ones in the area of one box: at most one for each pixel
_MEDIAN_OF_FOUR = 0.2982  # variance of the median of four normal deviates


def light_test(
    layout: Layout, maps: NDArray[np.float32], fwhm_px: float | None, *, boxes: int = 1
) -> LightTest:
    """Return the test of a sensor's windows.

    Parameters
    ----------
    layout : Layout
    maps : (2, h, w) float32
        Dark and electrons per ADU of each pixel of a frame, NaN in bad ones.
    fwhm_px : float, optional
        Width of the spots, if it is known.
    boxes : int
        Number of tests, of boxes of several sizes, of which a dark window passes none.
    """
    ny, nx = layout.window
    box = box_px(layout.window, fwhm_px)
    limit, unit = 0.0, 1.0
    if box:
        trials = min(_BOXES / box**2, 1.0) * ny * nx * boxes
        limit = NormalDist().inv_cdf((1.0 - FALSE_LIGHT) ** (1.0 / trials))
        unit = math.sqrt(box**2 + _MEDIAN_OF_FOUR * box**4 / (0.5 * (ny + nx)))
    lanes = lanes_for(np.float32, max(width for width in WIDTHS if width <= max(nx, min(WIDTHS))))
    last = np.zeros(lanes.width, np.float32)
    last[lanes.width - nx % lanes.width :] = 1.0
    corners, numbers = np.ascontiguousarray(layout.corners), (np.float32(limit), np.float32(unit))
    none = np.zeros(0, np.int64)
    return LightTest(lanes, last, np.ascontiguousarray(maps), corners, ny, nx, box, *numbers, none)


class MeanLight:
    """Test of the windows of mean images: of many frames, or of those so far.

    Spots that move are wider in the mean: a window is dark if nothing shows in the box of a spot, nor in one
    twice as wide.

    Parameters
    ----------
    layout, maps, fwhm_px
        As for `light_test`.
    """

    def __init__(self, layout: Layout, maps: NDArray[np.float32], fwhm_px: float | None) -> None:
        usual = box_px(layout.window, fwhm_px)
        self._n, self._window = len(layout), layout.window
        self._tests = [
            light_test(layout, maps, box / _BOX_OF_FWHM, boxes=2) for box in (usual, 2 * usual + 1) if usual
        ]

    def significances(self, mean: NDArray[np.generic]) -> NDArray[np.float32]:
        """Return the significance of each window's flux in a mean frame (h, w) [ADU], (n,), over the limit.

        It is below 1 in dark windows, and infinite in windows too small for a test. NaN marks pixels without
        any value.
        """
        frames = np.ascontiguousarray(mean, np.float32)[None]
        scratch = np.empty(scratch_size(self._n, *self._window), np.float32)
        largest, found = np.zeros(self._n, np.float32), np.empty(self._n, np.float32)
        for test in self._tests:
            significances(test, frames, found, scratch)
            np.maximum(largest, found / test.limit, out=largest)
        return largest if self._tests else np.full(self._n, np.inf, np.float32)


def box_px(window: tuple[int, int], fwhm_px: float | None) -> int:
    """Return the side of the box of pixels that holds most of a spot: odd; 0 in windows too small for one."""
    side = min(window)
    if side < _FEWEST_PX:
        return 0
    wanted = _LEAST_BOX_PX
    if fwhm_px is not None:
        wanted = max(2 * round((_BOX_OF_FWHM * fwhm_px - 1) / 2) + 1, _LEAST_BOX_PX)
    most = side // 2
    return max(1, min(wanted, most - (most + 1) % 2))
