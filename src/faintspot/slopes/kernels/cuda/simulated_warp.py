"""Twins, for Numba's simulator, of what the threads of a warp do together.

The simulator runs one block at a time, each thread of it as a Python thread, and a block is one warp. So one
board for all will do: everybody writes, everybody waits, everybody reads. Two boards take turns, since nobody
may write to one that others still read.
"""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
from numba import cuda
from numpy.typing import NDArray

_boards: NDArray[np.float32] = np.zeros((2, 32), np.float32)


def _exchange(value: Any) -> NDArray[np.float32]:
    """Return the values of all threads of the warp."""
    thread: Any = threading.current_thread()
    thread.turn = board = 1 - getattr(thread, "turn", 0)
    _boards[board, cuda.threadIdx.x] = value
    cuda.syncthreads()
    values: NDArray[np.float32] = _boards[board]
    return values


def shuffle(value: Any, lane: int) -> Any:
    """The number that another thread of the warp holds."""
    return _exchange(value)[lane]


def total(value: Any) -> Any:
    """Sum over the warp, in the order of a butterfly of exchanges."""
    values = _exchange(value)
    while len(values) > 1:
        half = len(values) // 2
        values = values[:half] + values[half:]
    return values[0]


def largest(value: Any) -> Any:
    """Largest number of the warp."""
    return _exchange(value).max()


def synchronise() -> None:
    """Wait until all threads of the warp are here."""
    cuda.syncthreads()


def inverse_root(value: Any) -> Any:
    """1 / sqrt(value)."""
    return np.float32(1.0) / np.sqrt(value)
