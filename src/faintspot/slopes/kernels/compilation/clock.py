"""The monotonic clock, and sleeping, within compiled code."""

from __future__ import annotations

import time
from typing import Any

from llvmlite import ir
from numba.core import types

from faintspot.slopes.kernels.compilation.simd import intrinsic

_SECOND_NS = 1_000_000_000
_INT, _LONG = ir.IntType(32), ir.IntType(64)
_MOMENT = ir.ArrayType(_LONG, 2)  # struct timespec of 64-bit systems: seconds, nanoseconds
_CLOCK = _INT(getattr(time, "CLOCK_MONOTONIC", 1))


def _library(builder: Any, name: str, *arguments: Any) -> None:
    """Call a function of the C library that returns an int, which is ignored."""
    kind = ir.FunctionType(_INT, [argument.type for argument in arguments])
    known = builder.module.globals.get(name)
    builder.call(known or ir.Function(builder.module, kind, name), arguments)


def _moment(builder: Any) -> Any:
    with builder.goto_entry_block():
        return builder.alloca(_MOMENT)


@intrinsic
def now_ns(typing_context: Any) -> Any:
    """Return the time of CLOCK_MONOTONIC, ns, as time.monotonic_ns does."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        moment = _moment(builder)
        _library(builder, "clock_gettime", _CLOCK, moment)
        now = builder.load(moment)
        seconds, rest = builder.extract_value(now, 0), builder.extract_value(now, 1)
        return builder.add(builder.mul(seconds, _LONG(_SECOND_NS)), rest)

    return types.int64(), emit


@intrinsic
def sleep_ns(typing_context: Any, duration: Any) -> Any:
    """Sleep for a duration, ns, at least 0, or until a signal comes."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        moment = _moment(builder)
        seconds = builder.sdiv(args[0], _LONG(_SECOND_NS))
        value = builder.insert_value(ir.Constant(_MOMENT, ir.Undefined), seconds, 0)
        value = builder.insert_value(value, builder.srem(args[0], _LONG(_SECOND_NS)), 1)
        builder.store(value, moment)
        _library(builder, "nanosleep", moment, _MOMENT.as_pointer()(None))
        return context.get_dummy_value()

    return types.void(types.int64), emit
