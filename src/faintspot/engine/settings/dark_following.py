"""Running mean of the windows of an engine's frames, which shows sub-apertures without any flux."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from faintspot.slopes.kernels.compilation.compiling import Direct
from faintspot.slopes.kernels.driver.dark import BRIGHT, add_windows
from faintspot.slopes.pipeline.light import MeanLight
from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline
from faintspot.slopes.sensor.layout import Layout

EVERY = 32
"""Frames of which one is added to the mean of a window."""
_SHORT, _LONG = 8, 256  # frames in the mean of each window: of bright stars, of others
_BRIGHT_PART = 0.9  # of the windows, below the significance of which a star is not bright


class DarkFollower:
    """Follower of the sub-apertures that have no flux in the mean of many frames.

    Each frame adds a part of the windows to their means, so that no frame takes longer than others. With
    bright stars, a window is dark when it has no flux for a few hundred frames; with faint ones, or none at
    all, when 256 frames of it, spread over 8192, show none. It is lit again as soon as flux shows.

    Parameters
    ----------
    pipeline : SlopePipeline
        Of the engine; only layout, calibration and the width of the spots count.
    """

    def __init__(self, pipeline: SlopePipeline) -> None:
        layout, test = pipeline.layout, pipeline.light_test
        self._n, self._test = len(layout), test
        ny, nx = layout.window
        stacked = Layout.stacked(self._n, layout.window)
        maps = layout.images(test.maps).reshape(2, self._n * ny, nx)
        self._light = MeanLight(stacked, maps, pipeline.plan.typical_fwhm_px)
        self._mean = np.zeros((self._n * ny, nx), np.float32)
        self._part, self._frames, self._most = 0, 0, _LONG
        self._add = {dtype: Direct(add_windows) for dtype in map(np.dtype, (np.uint16, np.float32))}
        for dtype in self._add:  # compile now
            self._add[dtype](test, np.zeros((1, *layout.frame_shape), dtype), 0, 0, 1.0, self._mean)
        self.dark = np.zeros(self._n, np.bool_)
        """Mask of the dark sub-apertures, (n,)."""
        self.changes = 0
        """Number of changes of `dark`."""

    def take(self, frames: NDArray[np.generic]) -> None:
        """Add a part of a frame (1, h, w) to the means; for the engine's thread."""
        if not self._test.box:
            return
        start, stop = (part * self._n // EVERY for part in (self._part, self._part + 1))
        weight = 1.0 / min(self._frames + 1, self._most)
        self._add[frames.dtype](self._test, frames, start, stop, weight, self._mean)
        self._part += 1
        if self._part == EVERY:
            self._part, self._frames = 0, min(self._frames + 1, self._most)

    def look(self) -> bool:
        """Find the dark sub-apertures anew; return whether any have changed. For one thread at a time."""
        frames = self._frames
        if frames < _SHORT or not self._test.box:
            return False
        found = self._light.significances(self._mean)
        bright = float(np.quantile(found, _BRIGHT_PART)) * float(self._test.limit) >= BRIGHT
        self._most = _SHORT if bright else _LONG
        dark = self.dark & (found < 1.0)
        if bright or frames >= _LONG:
            dark = found < 1.0
        if np.array_equal(dark, self.dark):
            return False
        self.dark, self.changes = dark, self.changes + 1
        return True
