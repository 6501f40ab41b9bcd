"""Capabilities of the processor: vector width, and scratch memory aligned to it."""

from __future__ import annotations

import os
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from faintspot.base.errors import InputError
from faintspot.slopes.kernels.compilation.compiling import compile_target
from faintspot.slopes.kernels.compilation.simd import Lanes

WIDTHS = (4, 8, 16)
_ENVIRONMENT = "FAINTSPOT_SIMD_WIDTH"


def _native_width() -> int:
    """Return the number of float32 values in one vector register of the target processor."""
    features = compile_target().features
    if {"avx512f", "avx512vl"} <= features:
        return 16
    return 8 if "avx2" in features else 4


@cache
def _lanes(dtype: str, width: int) -> Lanes:
    return Lanes(dtype, width)


def lanes_for(dtype: DTypeLike, width: int | None = None) -> Lanes:
    """Return the vector type to compute with: W sub-apertures in float32, half as many in float64.

    Parameters
    ----------
    dtype : float32 or float64
    width : int, optional
        float32 lanes: 4, 8 or 16. Default: the environment variable FAINTSPOT_SIMD_WIDTH, else what the
        processor has.

    Raises
    ------
    InputError
        If the width is none of these.
    """
    wanted: Any = width if width is not None else os.environ.get(_ENVIRONMENT, _native_width())
    if str(wanted) not in {str(choice) for choice in WIDTHS}:
        raise InputError(f"SIMD width = {wanted!r} (argument or {_ENVIRONMENT}): expected 4, 8 or 16")
    name = np.dtype(dtype).name
    return _lanes(name, int(wanted) if name == "float32" else int(wanted) // 2)


def aligned_zeros(size: int, dtype: DTypeLike) -> NDArray[Any]:
    """Return a zeroed array aligned to a cache line, so that loads of whole vectors never straddle two."""
    itemsize = np.dtype(dtype).itemsize
    memory = np.zeros(size + 64 // itemsize, dtype)
    start = (-memory.ctypes.data % 64) // itemsize
    return memory[start : start + size]
