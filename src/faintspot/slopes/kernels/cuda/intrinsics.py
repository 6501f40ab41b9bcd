"""One GPU instruction that Numba has no name for; imported only where there is a compiler for it."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.cuda import types
from numba.cuda.cgutils import get_or_insert_function
from numba.cuda.extending import intrinsic


def _inverse_root(typing_context: Any, value: Any) -> Any:
    """1 / sqrt(value) of a normal float32, to 2 units in the last place (rsqrt.approx.ftz.f32)."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind = ir.FunctionType(ir.FloatType(), [ir.FloatType()])
        function = get_or_insert_function(builder.module, kind, "llvm.nvvm.rsqrt.approx.ftz.f")
        return builder.call(function, arguments)

    return types.float32(types.float32), generate


inverse_root: Any = intrinsic(_inverse_root)
