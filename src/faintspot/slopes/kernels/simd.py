"""An explicit vector type for Numba: kernels work on W sub-apertures at once, yet read like scalar code.

A *lane* is one sub-aperture. ``Lanes("float32", 16)`` is a kind of vector: passed to a compiled function, it
selects the specialisation, and ``load(lanes, array, offset)`` gives W consecutive numbers as one value
that knows ``+ - * /``, comparisons and the functions below. Only generic LLVM operations are used, so the
same code compiles to AVX-512, AVX2, SSE or NEON.

Offsets count array elements and are not checked: kernels own their scratch memory.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias

from llvmlite import ir
from numba import extending
from numba.core import cgutils, types
from numba.core.datamodel import models, register_default
from numba.core.imputils import lower_builtin
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import NativeValue, unbox

from faintspot.slopes.kernels.compiling import compile_target, vector_registers

intrinsic: Any = extending.intrinsic  # to a type checker, what it returns has the signature of its typing


@dataclass(frozen=True)
class Lanes:
    """A kind of vector: `width` numbers of type `dtype` ("float32" or "float64")."""

    dtype: str
    width: int

    @cached_property
    def _numba_type_(self) -> LanesKind:
        """Type looked up first by Numba's dispatcher, which saves microseconds in every call."""
        return LanesKind(self.dtype, self.width)


class LanesKind(types.Type):
    """Numba's type of a Lanes object: no data, it only tells functions which vector to use."""

    def __init__(self, dtype: str, width: int) -> None:
        self.scalar = types.float32 if dtype == "float32" else types.float64
        self.width = width
        super().__init__(name=f"LanesKind({dtype}, {width})")


Vector: TypeAlias = Any
"""W numbers in one register; their operators are defined below, where no type checker sees them."""
Pair = tuple[Vector, Vector]


class VectorKind(types.Type):
    """Numba's type of W numbers in one register."""

    def __init__(self, scalar: types.Float, width: int) -> None:
        self.scalar = scalar
        self.width = width
        super().__init__(name=f"VectorKind({scalar}, {width})")


class MaskKind(types.Type):
    """Numba's type of W truth values."""

    def __init__(self, width: int) -> None:
        self.width = width
        super().__init__(name=f"MaskKind({width})")


def _llvm_scalar(scalar: types.Float) -> ir.Type:
    return ir.FloatType() if scalar == types.float32 else ir.DoubleType()


def _llvm_vector(vector: VectorKind) -> ir.VectorType:
    return ir.VectorType(_llvm_scalar(vector.scalar), vector.width)


@unbox(LanesKind)
def _unbox_lanes(kind: Any, value: Any, context: Any) -> NativeValue:
    return NativeValue(context.context.get_dummy_value())


register_default(LanesKind)(models.OpaqueModel)


@register_default(VectorKind)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: VectorKind) -> None:
        super().__init__(manager, kind, _llvm_vector(kind))


@register_default(MaskKind)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: MaskKind) -> None:
        super().__init__(manager, kind, ir.VectorType(ir.IntType(1), kind.width))


# Operators -------------------------------------------------------------------------------------------


def _register_binary(operation: Any, emit: Callable[..., Any], comparison: bool) -> None:
    """Make `operation` work on two vectors of the same kind."""

    @infer_global(operation)
    class _Template(AbstractTemplate):
        def generic(self, args: Any, kws: Any) -> Any:
            if len(args) == 2 and isinstance(args[0], VectorKind) and args[0] == args[1]:
                return signature(MaskKind(args[0].width) if comparison else args[0], *args)
            return None

    @lower_builtin(operation, VectorKind, VectorKind)
    def _lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return emit(builder, *args)


_register_binary(operator.add, lambda b, x, y: b.fadd(x, y), False)
_register_binary(operator.sub, lambda b, x, y: b.fsub(x, y), False)
_register_binary(operator.mul, lambda b, x, y: b.fmul(x, y), False)
_register_binary(operator.truediv, lambda b, x, y: b.fdiv(x, y), False)
_register_binary(operator.gt, lambda b, x, y: b.fcmp_ordered(">", x, y), True)
_register_binary(operator.ge, lambda b, x, y: b.fcmp_ordered(">=", x, y), True)
_register_binary(operator.lt, lambda b, x, y: b.fcmp_ordered("<", x, y), True)
_register_binary(operator.le, lambda b, x, y: b.fcmp_ordered("<=", x, y), True)


# Memory ----------------------------------------------------------------------------------------------


def _element(context: Any, builder: Any, sig: Any, args: Any, array: int) -> Any:
    """Return the pointer to an element of an array, whose offset is the argument after it."""
    offset = context.cast(builder, args[array + 1], sig.args[array + 1], types.intp)
    return builder.gep(_data(context, builder, sig, args, array), [offset])


def _data(context: Any, builder: Any, sig: Any, args: Any, array: int) -> Any:
    return context.make_array(sig.args[array])(context, builder, args[array]).data


def _vectors(builder: Any, pointer: Any, vector: VectorKind) -> Any:
    return builder.bitcast(pointer, _llvm_vector(vector).as_pointer())


@intrinsic
def copy_transposed(
    typing_context: Any, lanes: Any, source: Any, starts: Any, shift: Any, target: Any, to: Any
) -> Any:
    """Copy W x W numbers: element j of row i of the source becomes element i of row j of the target.

    Row i of the source starts at element starts[i] + shift; rows of the target follow each other from element
    `to`. The source holds unsigned integers or numbers of the lanes' own type.
    """
    vector = VectorKind(lanes.scalar, lanes.width)
    kind = source.dtype

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        data, first = (_data(context, builder, sig, args, k) for k in (1, 2))
        offset, rows = context.cast(builder, args[3], sig.args[3], types.intp), []
        for lane in range(lanes.width):
            start = builder.load(builder.gep(first, [ir.IntType(64)(lane)]))
            pointer = builder.gep(data, [builder.add(start, offset)])
            rows.append(_load_widened(context, builder, pointer, kind, vector))
        pointer = _vectors(builder, _element(context, builder, sig, args, 4), vector)
        for lane, values in enumerate(_transposed(builder, rows)):
            builder.store(
                values, builder.gep(pointer, [ir.IntType(64)(lane)]), align=lanes.scalar.bitwidth // 8
            )
        return context.get_dummy_value()

    return types.void(lanes, source, starts, shift, target, to), emit


def _transposed(builder: Any, rows: list[Any]) -> list[Any]:
    """Transpose W vectors of W numbers: exchange blocks of 1, 2, 4 ... off the diagonal."""
    width, size = len(rows), 1
    while size < width:
        lower = [lane if not lane & size else width + lane - size for lane in range(width)]
        upper = [lane + size if not lane & size else width + lane for lane in range(width)]
        masks = [ir.Constant(ir.VectorType(ir.IntType(32), width), mask) for mask in (lower, upper)]
        rows = list(rows)
        for i in range(width):
            if not i & size:
                a, b = rows[i], rows[i + size]
                rows[i], rows[i + size] = (builder.shuffle_vector(a, b, mask) for mask in masks)
        size *= 2
    return rows


@intrinsic
def load(typing_context: Any, lanes: Any, array: Any, offset: Any) -> Any:
    """Load W consecutive elements of a contiguous array, from element `offset`."""
    vector = VectorKind(lanes.scalar, lanes.width)

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pointer = _vectors(builder, _element(context, builder, sig, args, 1), vector)
        return builder.load(pointer, align=lanes.scalar.bitwidth // 8)

    return vector(lanes, array, offset), emit


@intrinsic
def widened(typing_context: Any, lanes: Any, array: Any, offset: Any) -> Any:
    """Load W consecutive unsigned integers, or numbers of the lanes' own type, as the latter."""
    vector = VectorKind(lanes.scalar, lanes.width)

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pointer = _element(context, builder, sig, args, 1)
        return _load_widened(context, builder, pointer, array.dtype, vector)

    return vector(lanes, array, offset), emit


def _load_widened(context: Any, builder: Any, pointer: Any, kind: Any, vector: VectorKind) -> Any:
    packed = ir.VectorType(context.get_data_type(kind), vector.width)
    values = builder.load(builder.bitcast(pointer, packed.as_pointer()), align=kind.bitwidth // 8)
    return values if kind == vector.scalar else builder.uitofp(values, _llvm_vector(vector))


@intrinsic
def gathered(typing_context: Any, lanes: Any, array: Any, places: Any, offset: Any) -> Any:
    """Load W elements of a contiguous array from the places that `places` has from element `offset`."""
    vector = VectorKind(lanes.scalar, lanes.width)

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        data, start = _data(context, builder, sig, args, 1), _element(context, builder, sig, args, 2)
        values = ir.Constant(_llvm_vector(vector), ir.Undefined)
        for lane in range(lanes.width):
            place = builder.load(builder.gep(start, [ir.IntType(64)(lane)]))
            place = context.cast(builder, place, sig.args[2].dtype, types.intp)
            values = builder.insert_element(
                values, builder.load(builder.gep(data, [place])), ir.IntType(32)(lane)
            )
        return values

    return vector(lanes, array, places, offset), emit


@intrinsic
def store(typing_context: Any, array: Any, offset: Any, value: Any) -> Any:
    """Store W consecutive elements of a contiguous array, from element `offset`."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pointer = _vectors(builder, _element(context, builder, sig, args, 0), value)
        builder.store(args[2], pointer, align=value.scalar.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(array, offset, value), emit


@intrinsic
def store_all(typing_context: Any, array: Any, offset: Any, values: Any) -> Any:
    """Store a tuple of vectors, one after the other, from element `offset`."""
    vector = values.dtype

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pointer = _vectors(builder, _element(context, builder, sig, args, 0), vector)
        for i in range(values.count):
            value, to = builder.extract_value(args[2], i), builder.gep(pointer, [ir.IntType(64)(i)])
            builder.store(value, to, align=vector.scalar.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(array, offset, values), emit


@intrinsic
def get(typing_context: Any, array: Any, offset: Any) -> Any:
    """One element of a contiguous array of any number of dimensions, by its flat offset."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.load(_element(context, builder, sig, args, 0))

    return array.dtype(array, offset), emit


@intrinsic
def put(typing_context: Any, array: Any, offset: Any, value: Any) -> Any:
    """Set one element of a contiguous array, by its flat offset."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        number = context.cast(builder, args[2], sig.args[2], sig.args[0].dtype)
        builder.store(number, _element(context, builder, sig, args, 0))
        return context.get_dummy_value()

    return types.void(array, offset, value), emit


@intrinsic
def splat(typing_context: Any, lanes: Any, number: Any) -> Any:
    """The same number in every lane."""
    vector = VectorKind(lanes.scalar, lanes.width)

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        scalar = context.cast(builder, args[1], sig.args[1], lanes.scalar)
        llvm_vector = _llvm_vector(vector)
        index = ir.Constant(ir.IntType(32), 0)
        first = builder.insert_element(ir.Constant(llvm_vector, ir.Undefined), scalar, index)
        zeros = ir.Constant(ir.VectorType(ir.IntType(32), lanes.width), [index] * lanes.width)
        return builder.shuffle_vector(first, ir.Constant(llvm_vector, ir.Undefined), zeros)

    return vector(lanes, number), emit


# Functions -------------------------------------------------------------------------------------------


def _call(builder: Any, name: str, vector: VectorKind, args: Any) -> Any:
    llvm_vector = _llvm_vector(vector)
    suffix = f"v{vector.width}f{vector.scalar.bitwidth}"
    function_type = ir.FunctionType(llvm_vector, [llvm_vector] * len(args))
    function = cgutils.get_or_insert_function(builder.module, function_type, f"llvm.{name}.{suffix}")
    return builder.call(function, args)


def _unary(name: str) -> Any:
    """Return LLVM's function of a vector."""

    @intrinsic
    def function(typing_context: Any, a: Any) -> Any:
        return a(a), lambda context, builder, sig, args: _call(builder, name, a, args)

    return function


def _extreme(order: str) -> Any:
    """Return the function of two vectors a and b that chooses a where it is before b, else b."""

    @intrinsic
    def function(typing_context: Any, a: Any, b: Any) -> Any:
        def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            return builder.select(builder.fcmp_ordered(order, *args), *args)

        return a(a, b), emit

    return function


square_root = _unary("sqrt")
"""Correctly rounded square root."""
rounded = _unary("rint")
"""The nearest whole number, halves to even."""
absolute = _unary("fabs")
"""|a|."""
maximum, minimum = _extreme(">"), _extreme("<")
"""The larger or the smaller of a and b; b where either is NaN (one instruction on every target)."""


@intrinsic
def multiply_add(typing_context: Any, a: Any, b: Any, c: Any) -> Any:
    """Return a * b + c, in one rounding where the hardware can."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _call(builder, "fmuladd", a, args)

    return a(a, b, c), emit


# Hardware estimates by feature of the target and float32 lanes: LLVM's name, arguments after `a`.
# With avx512vl all widths use the same estimate, so that results do not depend on the width.
_ROOT_ESTIMATES = {
    ("avx512vl", 16): "llvm.x86.avx512.rsqrt14.ps.512",
    ("avx512vl", 8): "llvm.x86.avx512.rsqrt14.ps.256",
    ("avx512vl", 4): "llvm.x86.avx512.rsqrt14.ps.128",
    ("avx", 8): "llvm.x86.avx.rsqrt.ps.256",
    ("sse", 4): "llvm.x86.sse.rsqrt.ps",
}
_INVERSE_ESTIMATES = {key: name.replace("rsqrt", "rcp") for key, name in _ROOT_ESTIMATES.items()}


def _estimate(builder: Any, vector: VectorKind, value: Any, names: dict[tuple[str, int], str]) -> Any:
    """Emit the hardware's estimate, to 4e-4 or better; None where there is none."""
    features = compile_target().features
    usable = [key for key in names if key[1] == vector.width and key[0] in features]
    if not usable or vector.scalar != types.float32:
        return None
    feature, width = usable[0]
    llvm_vector, arguments = _llvm_vector(vector), [value]
    if feature == "avx512vl":  # masked: what to return in switched-off lanes, and the mask
        bits = ir.IntType(max(width, 8))
        arguments += [ir.Constant(llvm_vector, None), ir.Constant(bits, -1)]
    kind = ir.FunctionType(llvm_vector, [argument.type for argument in arguments])
    function = cgutils.get_or_insert_function(builder.module, kind, names[usable[0]])
    return builder.call(function, arguments)


def _constant(vector: VectorKind, number: float) -> Any:
    return ir.Constant(
        _llvm_vector(vector), [ir.Constant(_llvm_scalar(vector.scalar), number)] * vector.width
    )


@intrinsic
def twice_reciprocal_square_root(typing_context: Any, a: Any) -> Any:
    """2 / sqrt(a).

    In float32, where the hardware has an estimate, that and one Newton step, y = r (3 - a r^2): one
    multiplication less than for 1 / sqrt(a). Relative error about 3e-7. Else correctly rounded operations.
    """

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        estimate = _estimate(builder, a, args[0], _ROOT_ESTIMATES)
        if estimate is None:
            return builder.fdiv(_constant(a, 2.0), _call(builder, "sqrt", a, args))
        minus = builder.fneg(builder.fmul(args[0], estimate))
        return builder.fmul(estimate, _call(builder, "fmuladd", a, (minus, estimate, _constant(a, 3.0))))

    return a(a), emit


@intrinsic
def reciprocal(typing_context: Any, a: Any) -> Any:
    """1 / a for ordinary numbers (not 0, not near the ends of the range), to about 3e-7 in float32."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        estimate = _estimate(builder, a, args[0], _INVERSE_ESTIMATES)
        if estimate is None:
            return builder.fdiv(_constant(a, 1.0), args[0])
        minus = builder.fneg(args[0])
        return builder.fmul(estimate, _call(builder, "fmuladd", a, (minus, estimate, _constant(a, 2.0))))

    return a(a), emit


@intrinsic
def sum_of(typing_context: Any, a: Any) -> Any:
    """The sum of all lanes, in any order."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        scalar, llvm_vector = _llvm_scalar(a.scalar), _llvm_vector(a)
        kind = ir.FunctionType(scalar, [scalar, llvm_vector])
        name = f"llvm.vector.reduce.fadd.v{a.width}f{a.scalar.bitwidth}"
        function = cgutils.get_or_insert_function(builder.module, kind, name)
        return builder.call(function, [ir.Constant(scalar, -0.0), args[0]], fastmath=("reassoc",))

    return a.scalar(a), emit


@intrinsic
def select(typing_context: Any, mask: Any, a: Any, b: Any) -> Any:
    """Choose a where the mask is true, else b."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.select(*args)

    return a(mask, a, b), emit


@intrinsic
def any_lane(typing_context: Any, mask: Any) -> Any:
    """Whether the mask is true in at least one lane."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        bits = builder.bitcast(args[0], ir.IntType(mask.width))
        return builder.icmp_unsigned("!=", bits, ir.IntType(mask.width)(0))

    return types.boolean(mask), emit


@intrinsic
def width_of(typing_context: Any, lanes: Any) -> Any:
    """W, as a compile-time constant."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return ir.Constant(ir.IntType(64), lanes.width)

    return types.int64(lanes), emit


@intrinsic
def align_stack(typing_context: Any, lanes: Any) -> Any:
    """Align the calling function's stack frame to cache lines, on x86 with 16 vector registers.

    LLVM spills vector registers to unaligned places otherwise. Depending on the depth of the stack, such a
    place crosses two pages of memory, where each access takes many times longer. Call it in functions that
    are not inlined.
    """

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        if compile_target().triple.startswith("x86_64") and vector_registers() == 16:
            attributes = builder.function.attributes
            attributes.add("uwtable")  # the default already, but llvmlite omits `alignstack` on its own
            attributes.alignstack = 64
        return context.get_dummy_value()

    return types.void(lanes), emit
