"""Compilation of CUDA code."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import cuda

from faintspot.slopes.kernels.cuda.availability import simulated

_INLINED = {} if simulated() else {"forceinline": True}  # of which the simulator knows nothing


def device(function: Callable[..., Any]) -> Any:
    """Make a function part of the kernels that call it, so that its arrays can live in registers."""
    return cuda.jit(device=True, **_INLINED)(function)


def kernel(function: Callable[..., Any]) -> Any:
    """Compile what the host launches."""
    return cuda.jit(function)
