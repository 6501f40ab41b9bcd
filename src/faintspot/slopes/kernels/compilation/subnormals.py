"""Numbers too small for full precision count as 0 while a thread measures.

Weights and exponentials far from a spot fall below the smallest normal number (1e-38), where some processors
take over a hundred times as long for an operation. Nothing that small matters to a slope.
"""

from __future__ import annotations

from typing import Any

import llvmlite.binding as llvm
from llvmlite import ir
from numba.core import cgutils, types

from faintspot.slopes.kernels.compilation.simd import intrinsic

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
