"""Mean of frames, some of whose pixels are not finite."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


class MeanFrame:
    """Mean of the finite values of each pixel, over frames that come in blocks.

    Parameters
    ----------
    shape : (int, int)
        Height and width of a frame.
    """

    def __init__(self, shape: tuple[int, ...]) -> None:
        self._total, self._count = np.zeros(shape), np.zeros(shape, np.int64)

    def add(self, block: NDArray[np.generic]) -> None:
        """Add frames, (n, h, w)."""
        finite = np.isfinite(block)
        self._total += np.where(finite, block, 0).sum(axis=0, dtype=np.float64)
        self._count += finite.sum(axis=0)

    @property
    def mean(self) -> NDArray[np.float64]:
        """(h, w), NaN in pixels that were never finite."""
        unknown = np.full(self._total.shape, np.nan)
        return np.asarray(np.divide(self._total, self._count, where=self._count > 0, out=unknown))
