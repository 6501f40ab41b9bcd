"""Frame numbers: count missing ones and detect restarts of their source."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

LARGEST_GAP = 1_000_000
"""Largest number of frames lost in a row, 17 minutes at 1 kHz; a larger gap counts as a restart."""


def left_out(before: int, after: int) -> int:
    """Return how many numbers are missing between two, or -1 if the source restarted.

    It restarted if the later number is not larger, or is larger by more than `LARGEST_GAP`.
    """
    between = after - before - 1
    return between if 0 <= between <= LARGEST_GAP else -1


def all_left_out(numbers: ArrayLike) -> NDArray[np.int64]:
    """Return `left_out` for every pair of successive numbers, (n - 1,)."""
    between = np.diff(np.asarray(numbers, np.int64)) - 1
    return np.where((between >= 0) & (between <= LARGEST_GAP), between, -1)
