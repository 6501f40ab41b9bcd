"""Capabilities of the processor: vector width, aligned scratch memory, and subnormals counted as 0."""

import os
from functools import cache
from typing import Any

import llvmlite.binding as llvm
import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numpy.typing import DTypeLike, NDArray

from faintspot.base.errors import InputError
from faintspot.slopes.kernels.compiling import compile_target
from faintspot.slopes.kernels.simd import Lanes, intrinsic

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


_FLUSH_X86 = 0x8040  # MXCSR: results and operands
_FLUSH_ARM = 1 << 24  # FPCR: both


def _call(builder: Any, name: str, result: Any, arguments: Any) -> Any:
    kind = ir.FunctionType(result, [argument.type for argument in arguments])
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), arguments)


def _control(builder: Any) -> Any:
    """Emit the thread's floating-point control register, 64 bits; 0 on processors that are not known."""
    triple, whole = llvm.get_process_triple(), ir.IntType(64)
    if "x86_64" in triple:
        place = cgutils.alloca_once(builder, ir.IntType(32))
        pointer = builder.bitcast(place, ir.IntType(8).as_pointer())
        _call(builder, "llvm.x86.sse.stmxcsr", ir.VoidType(), [pointer])
        return builder.zext(builder.load(place), whole)
    if "aarch64" in triple or "arm64" in triple:
        return _call(builder, "llvm.aarch64.get.fpcr", whole, [])
    return whole(0)


def _set_control(builder: Any, value: Any) -> None:
    triple = llvm.get_process_triple()
    if "x86_64" in triple:
        place = cgutils.alloca_once_value(builder, builder.trunc(value, ir.IntType(32)))
        pointer = builder.bitcast(place, ir.IntType(8).as_pointer())
        _call(builder, "llvm.x86.sse.ldmxcsr", ir.VoidType(), [pointer])
    elif "aarch64" in triple or "arm64" in triple:
        _call(builder, "llvm.aarch64.set.fpcr", ir.VoidType(), [value])


@intrinsic
def flush_subnormals(typing_context: Any) -> Any:
    """Let this thread take subnormal numbers as 0; return what `restore_control` needs to undo it."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        before = _control(builder)
        bits = _FLUSH_X86 if "x86_64" in llvm.get_process_triple() else _FLUSH_ARM
        _set_control(builder, builder.or_(before, ir.IntType(64)(bits)))
        return before

    return types.int64(), emit


@intrinsic
def restore_control(typing_context: Any, before: Any) -> Any:
    """Let this thread compute as before `flush_subnormals`."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        _set_control(builder, args[0])
        return context.get_dummy_value()

    return types.void(types.int64), emit
