"""What Python calls becomes machine code with all that it calls; what kernels call does not alone."""

from collections.abc import Iterator
from typing import Any

import numba
import numpy as np
import pytest
from numba.core.caching import NullCache

from faintspot.slopes.kernels.compilation import compiling
from faintspot.slopes.kernels.compilation.compiling import Direct, compiled, inlined

pytestmark = [pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is compiled")]


@inlined
def twice(value: Any) -> Any:
    return value + value


@compiled
def total_twice(values: Any) -> Any:
    total = 0.0
    for value in values:
        total += twice(value)
    return total


@compiled
def with_next(values: Any, following: Any) -> Any:
    return total_twice(values) + total_twice(following)


@compiled
def with_sign(number: Any, upwards: Any) -> Any:
    return number if upwards else -number


@compiled
def with_both(values: Any, more: Any) -> Any:
    return total_twice(values) + 0.5 * total_twice(more)


@compiled
def total_of(values: Any, more: Any) -> Any:
    if more is not None:
        return with_both(values, more)
    return 0.0


VALUES = np.arange(5.0)


@pytest.fixture(autouse=True, scope="module")
def _nothing_kept() -> Iterator[None]:
    """What comes from disk as a whole has no parts."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compiling, "kernel_cache", lambda *arguments: NullCache())
        yield


def test_a_part_has_neither_machine_code_nor_an_entry_from_python() -> None:
    assert with_next(VALUES, VALUES) == 40.0
    (part,) = total_twice.overloads.values()
    assert not part.library.get_pointer_to_function(part.fndesc.llvm_func_name)
    (whole,) = with_next.whole.overloads.values()
    assert whole.library.get_pointer_to_function(whole.fndesc.llvm_func_name)


def test_what_is_a_part_can_be_called_from_python_as_well() -> None:
    assert with_next(VALUES, VALUES) == 40.0
    assert total_twice(VALUES) == 20.0
    assert twice(1.5) == 3.0


def test_a_part_is_compiled_once_for_all_who_call_it() -> None:
    for array in (VALUES, VALUES.astype(np.float32)):
        assert with_next(array, VALUES) == with_next(VALUES, array) == 40.0
    assert len(total_twice.overloads) == 2


def test_other_compiled_functions_may_call_parts_and_parts_them() -> None:
    @numba.njit
    def outside(values: Any) -> Any:
        return total_twice(values) + 1.0

    @compiled
    def inside(values: Any) -> Any:
        return outside(values) + 1.0

    assert outside(VALUES) == 21.0
    assert inside(VALUES) == 22.0


def test_read_only_arrays_do_not_compile_anew_where_types_are_found_once() -> None:
    direct = Direct(total_twice)
    frozen = VALUES.copy()
    frozen.flags.writeable = False
    assert direct(frozen) == direct(VALUES) == 20.0


def test_a_part_is_not_compiled_anew_for_what_is_written_out() -> None:
    @compiled
    def three(offset: Any, upwards: Any) -> Any:
        return with_sign(1, True) + with_sign(offset, upwards) + with_sign(2, False)

    assert three(4, True) == 3
    assert len(with_sign.overloads) == 1


def test_of_what_is_none_nothing_is_compiled() -> None:
    @compiled
    def without(values: Any) -> Any:
        return total_of(values, None)

    @compiled
    def twofold(values: Any) -> Any:
        return total_of(values, values)

    assert without(VALUES) == 0.0
    assert not with_both.overloads
    assert twofold(VALUES) == 30.0
    assert with_both.overloads
