"""Communication between the threads of a warp: exchange, sum and extremes.

Numba's simulator does not support shuffles; equivalent functions replace them there. All other code is the
same on the GPU and in the simulator.
"""

from __future__ import annotations

import importlib
from typing import Any

from numba import cuda

from faintspot.slopes.kernels.cuda import simulated_warp
from faintspot.slopes.kernels.cuda.availability import simulated
from faintspot.slopes.kernels.cuda.compiling import device

_ALL = 0xFFFFFFFF


@device
def _shuffle(value: Any, lane: Any) -> Any:
    """The number that another thread of the warp holds."""
    return cuda.shfl_sync(_ALL, value, lane)


@device
def _total(value: Any) -> Any:
    """Sum over the warp; all threads get the same bits."""
    value += cuda.shfl_xor_sync(_ALL, value, 16)
    value += cuda.shfl_xor_sync(_ALL, value, 8)
    value += cuda.shfl_xor_sync(_ALL, value, 4)
    value += cuda.shfl_xor_sync(_ALL, value, 2)
    value += cuda.shfl_xor_sync(_ALL, value, 1)
    return value


@device
def _largest(value: Any) -> Any:
    """Largest number of the warp."""
    value = max(value, cuda.shfl_xor_sync(_ALL, value, 16))
    value = max(value, cuda.shfl_xor_sync(_ALL, value, 8))
    value = max(value, cuda.shfl_xor_sync(_ALL, value, 4))
    value = max(value, cuda.shfl_xor_sync(_ALL, value, 2))
    return max(value, cuda.shfl_xor_sync(_ALL, value, 1))


@device
def _synchronise() -> None:
    """Wait until all threads of the warp are here; they then see what the others wrote."""
    cuda.syncwarp(_ALL)


if simulated():
    shuffle, total = device(simulated_warp.shuffle), device(simulated_warp.total)
    largest, synchronise = device(simulated_warp.largest), device(simulated_warp.synchronise)
    inverse_root = device(simulated_warp.inverse_root)
else:
    shuffle, total, largest, synchronise = _shuffle, _total, _largest, _synchronise
    inverse_root = importlib.import_module("faintspot.slopes.kernels.cuda.intrinsics").inverse_root


@device
def smallest(value: Any) -> Any:
    """Smallest number of the warp."""
    return -largest(-value)
