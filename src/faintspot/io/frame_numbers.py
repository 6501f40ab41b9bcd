"""Numbers that count up: how many are missing, and where their source began anew."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

LARGEST_GAP = 1_000_000
"""Largest number of frames lost in a row, 17 minutes at 1 kHz; after a larger gap the source began anew."""


def left_out(before: int, after: int) -> int:
    """Return how many numbers are missing between two, or -1 where the source began anew.

    It began anew where the later number is not ahead, or by more than `LARGEST_GAP`.
    """
    between = after - before - 1
    return between if 0 <= between <= LARGEST_GAP else -1


def all_left_out(numbers: ArrayLike) -> NDArray[np.int64]:
    """Return `left_out` of every number and the next one, (n - 1,)."""
    between = np.diff(np.asarray(numbers, np.int64)) - 1
    return np.where((between >= 0) & (between <= LARGEST_GAP), between, -1)
