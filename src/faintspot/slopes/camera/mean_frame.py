"""Mean of frames, some of whose pixels are not finite; frames that were written twice."""

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


def are_repeated(frames: NDArray[np.generic], before: NDArray[np.generic] | None) -> NDArray[np.bool_]:
    """Return which frames (n, h, w) are the same as the one before, as a grabber writes them twice."""
    same = (frames[1:] == frames[:-1]).all(axis=(1, 2))
    first = before is not None and np.array_equal(frames[0], before)
    return np.concatenate([[first], same])
