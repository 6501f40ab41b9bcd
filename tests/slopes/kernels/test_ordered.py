"""Numbers for other processes: written and read in order, also where processors do not keep it themselves."""

import re
from collections.abc import Callable
from typing import Any

import llvmlite.binding as llvm
import numpy as np
import pytest
from numba import njit
from numba.core import types

from faintspot.slopes.kernels import ordered, streaming
from faintspot.slopes.kernels.ordered import fence, load, store

CELLS = types.Array(types.int64, 1, "C")
WHOLE = types.int64


def test_what_is_stored_is_loaded() -> None:
    cells = np.arange(4)
    for value in (-1, np.int64(2**62), True):
        store(cells, 2, value)
        fence()
        assert load(cells, 2) == cells[2] == value
    assert cells.tolist() == [0, 1, 1, 3]
    cells.flags.writeable = False  # as a reader's
    assert load(cells, 3) == 3


def instructions(function: Callable[..., Any], kinds: tuple[Any, ...], triple: str) -> list[str]:
    """Return what a function compiles to on a kind of processor, with what Python calls."""
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    compiled = njit(error_model="numpy", _nrt=False)(function)
    compiled.compile(kinds)
    module = llvm.parse_assembly(compiled.inspect_llvm(kinds))
    machine = llvm.Target.from_triple(triple).create_target_machine()
    module.triple, module.data_layout = triple, str(machine.target_data)
    lines = machine.emit_assembly(module).splitlines()
    return [" ".join(line.split()) for line in lines if re.match(r"\t[a-z]", line)]


@pytest.mark.parametrize(
    ("function", "kinds", "instruction", "times"),
    [
        (ordered._load, (CELLS, WHOLE), "ldar", 1),
        (ordered._store, (CELLS, WHOLE, WHOLE), "stlr", 1),
        (ordered._fence, (), "dmb ish", 1),
        (streaming.rows_are_there.py_func, (CELLS, *[WHOLE] * 4), "ldar", 3),
    ],
)
def test_order_costs_only_the_instructions_that_it_needs(
    function: Any, kinds: tuple[Any, ...], instruction: str, times: int
) -> None:
    """On aarch64 those that keep the order; on x86-64 none that costs more than a move."""
    arm = instructions(function, kinds, "aarch64-unknown-linux-gnu")
    assert sum(line.startswith(instruction) for line in arm) == times
    x86 = instructions(function, kinds, "x86_64-unknown-linux-gnu")
    assert x86
    assert not [line for line in x86 if re.match("lock|xchg|[lms]fence", line)]
