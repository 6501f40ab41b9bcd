"""What estimators with a prior are told of the coming frame's slopes."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

SMALLEST_STD_PX, LARGEST_STD_PX = 1e-6, 1e4
"""Of a prior."""


class Prior:
    """Predicted slopes and how sure they are, for one frame after the other, in memory that stays.

    Parameters
    ----------
    n : int
        Number of sub-apertures.
    largest_px : float
        Beyond which no slope is.

    Attributes
    ----------
    mean_px : (1, 2, n) float32
        0 where nothing is expected.
    std_px : (n,) float64
        Along each axis; NaN: not known, so that the settings' `prior_std_px` counts.
    changes : int
        How often `std_px` has changed.
    """

    def __init__(self, n: int, largest_px: float = math.inf) -> None:
        self.mean_px = np.zeros((1, 2, n), np.float32)
        self.std_px = np.full(n, np.nan)
        self.changes = 0
        self.largest_px = largest_px
        self._mean = self.mean_px.reshape(-1)
        self._given: Floats | None = None

    def forget(self) -> None:
        """Expect nothing."""
        self._mean[:] = 0.0
        self._take_std(None)

    def expect(self, mean_px: Floats, std_px: Floats | None = None) -> None:
        """Expect slopes; single ones that no frame can hold count as not expected.

        Parameters
        ----------
        mean_px : (2 n,) array
        std_px : (2 n,) array, optional
            How sure they are; an array that is given again still holds the same. Estimators have one width
            along both axes: the rms of both. Where one is not between `SMALLEST_STD_PX` and
            `LARGEST_STD_PX`, it is not known.
        """
        self._mean[:] = 0.0
        np.copyto(self._mean, mean_px, where=np.abs(mean_px) <= self.largest_px, casting="same_kind")
        self._take_std(std_px)

    def _take_std(self, std_px: Floats | None) -> None:
        if std_px is self._given:
            return
        self._given = std_px
        self.changes += 1
        self.std_px[:] = np.nan
        if std_px is not None:
            x, y = std_px.reshape(2, -1)
            known = np.minimum(x, y) >= SMALLEST_STD_PX
            known &= np.maximum(x, y) <= LARGEST_STD_PX
            self.std_px[known] = np.hypot(x[known], y[known]) / math.sqrt(2)
