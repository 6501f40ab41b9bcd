"""Atomic loads and stores for signalling between processes and threads (acquire/release).

Who sees a number that `store` wrote, through `load` or `look_at`, also sees all that was written before it.
`fence` is for memory that is written anew while others may read it: it stands between saying so and writing,
and between reading and looking whether anybody has said so.

These are LLVM's atomic operations (release, acquire, and a fence of both). On x86-64, which keeps this order
by itself, they are plain moves, and the fence is nothing; on aarch64, which does not, stlr, ldar and dmb.
"""

from __future__ import annotations

from typing import Any

from numba.core import types

from faintspot.slopes.kernels.compilation.compiling import at_once
from faintspot.slopes.kernels.compilation.simd import intrinsic

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
