"""Prior of the coming frame's slopes for estimators that use one."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

SMALLEST_STD_PX, LARGEST_STD_PX = 1e-6, 1e4
"""Smallest and largest standard deviation of a prior [px]."""


class SlopePrior:
    """Predicted slopes and their uncertainty for each frame in turn, in fixed memory.

    Parameters
    ----------
    n : int
        Number of sub-apertures.
    largest_px : float
        Largest possible slope.

    Attributes
    ----------
    mean_px : (1, 2, n) float32
        Predicted slopes; 0 where there is no prediction.
    std_px : (n,) float64
        Standard deviation along each axis; NaN: unknown, so that the settings' `prior_std_px` applies.
    changes : int
        Number of changes of `std_px`.
    """

    def __init__(self, n: int, largest_px: float = math.inf) -> None:
        self.mean_px = np.zeros((1, 2, n), np.float32)
        self.std_px = np.full(n, np.nan)
        self.changes = 0
        self.largest_px = largest_px
        self._mean = self.mean_px.reshape(-1)
        self._std_px: Floats | None = None

    def forget(self) -> None:
        """Remove the prediction."""
        self._mean[:] = 0.0
        self._take_std(None)

    def expect(self, mean_px: Floats, std_px: Floats | None = None) -> None:
        """Set predicted slopes; values that no frame can have count as no prediction.

        Parameters
        ----------
        mean_px : (2 n,) array
        std_px : (2 n,) array, optional
            Standard deviations; the same array given again must hold the same values. Estimators have one
            width for both axes: the rms of both. A width outside `SMALLEST_STD_PX` to `LARGEST_STD_PX` counts
            as unknown.
        """
        self._mean[:] = 0.0
        np.copyto(self._mean, mean_px, where=np.abs(mean_px) <= self.largest_px, casting="same_kind")
        self._take_std(std_px)

    def _take_std(self, std_px: Floats | None) -> None:
        if std_px is self._std_px:
            return
        self._std_px = std_px
        self.changes += 1
        self.std_px[:] = np.nan
        if std_px is not None:
            x, y = std_px.reshape(2, -1)
            usable = np.minimum(x, y) >= SMALLEST_STD_PX
            usable &= np.maximum(x, y) <= LARGEST_STD_PX
            self.std_px[usable] = np.hypot(x[usable], y[usable]) / math.sqrt(2)
