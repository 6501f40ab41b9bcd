"""Atomic loads and stores for signalling between processes and threads (acquire/release).

Who sees a number that `store` wrote, through `load` or `look_at`, also sees all that was written before it.
`fence` is for memory that is written anew while others may read it: it stands between saying so and writing,
and between reading and looking whether anybody has said so.

These are LLVM's atomic operations (release, acquire, and a fence of both). On x86-64, which keeps this order
by itself, they are plain moves, and the fence is nothing; on aarch64, which does not, stlr, ldar and dmb.
"""

import time
from typing import Any

from llvmlite import ir
from numba.core import types

from faintspot.slopes.kernels.compiling import at_once
from faintspot.slopes.kernels.simd import intrinsic

_CELLS = types.Array(types.int64, 1, "C")


def _pointer(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    place = context.cast(builder, args[1], sig.args[1], types.intp)
    return builder.gep(context.make_array(sig.args[0])(context, builder, args[0]).data, [place])


@intrinsic
def look_at(typing_context: Any, cells: Any, offset: Any) -> Any:
    """One whole number that another process writes; what that process wrote before it is seen after it."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.load_atomic(_pointer(context, builder, sig, args), "acquire", 8)

    return types.int64(cells, offset), emit


@intrinsic
def _publish(typing_context: Any, cells: Any, offset: Any, value: Any) -> Any:
    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        builder.store_atomic(args[2], _pointer(context, builder, sig, args), "release", 8)
        return context.get_dummy_value()

    return types.void(cells, offset, types.int64), emit


@intrinsic
def _keep_apart(typing_context: Any) -> Any:
    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        builder.fence("acq_rel")
        return context.get_dummy_value()

    return types.void(), emit


def _load(cells: Any, place: Any) -> Any:
    return look_at(cells, place)


def _store(cells: Any, place: Any, value: Any) -> None:
    _publish(cells, place, value)


def _fence() -> None:
    _keep_apart()


load = at_once(_load, _CELLS, types.int64)
"""`load(cells, place)`: the number at a place of an int64 array (n,), contiguous; nothing is checked."""
store = at_once(_store, _CELLS, types.int64, types.int64)
"""`store(cells, place, value)`: write it."""
fence = at_once(_fence)
"""`fence()`: what is before it in the program happens before what is after it, for everybody."""


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
