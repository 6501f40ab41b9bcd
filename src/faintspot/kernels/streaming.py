"""Slopes of a frame while it arrives: every group of sub-apertures as soon as its last row is there.

The camera's process writes rows into shared memory and then says how many are there. Waiting for them happens
inside the compiled code, without Python: nothing lies between the arrival of a row and the work on it.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import llvmlite.binding as llvm
from llvmlite import ir
from numba.core import types

from faintspot.kernels.compiling import compiled
from faintspot.kernels.groups import copied
from faintspot.kernels.ordered import look_at
from faintspot.kernels.simd import intrinsic

LOOKS_BETWEEN_STOPS = 1024  # at the progress, between two looks at whether to give up


class Arrival(NamedTuple):
    """Number of rows of a frame that have arrived, as written by another process."""

    cells: Any
    """int64 array in shared memory."""
    frame_cell: Any
    """Index of the cell with the number of the arriving frame."""
    rows_cell: Any
    """Index of the cell with the number of rows that have arrived."""
    control: Any
    """int64 array: waiting ends when the number at `stop_cell` is not 0."""
    stop_cell: Any


@intrinsic
def breathe(typing_context: Any) -> Any:
    """Yield to the other hardware thread while waiting, if the processor has an instruction for it."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        if "x86" in llvm.get_process_triple():
            kind = ir.FunctionType(ir.VoidType(), [])
            builder.call(builder.module.declare_intrinsic("llvm.x86.sse2.pause", fnty=kind), [])
        return context.get_dummy_value()

    return types.void(), emit


@compiled
def rows_are_there(progress: Any, frame_cell: Any, rows_cell: Any, frame: Any, rows: Any) -> Any:
    """Return whether the given number of rows of a frame, or a later frame, have arrived."""
    arriving = look_at(progress, frame_cell)
    if arriving != frame:
        return arriving > frame
    there = look_at(progress, rows_cell)
    # Between the two looks the next frame may have begun, with fewer rows.
    now = look_at(progress, frame_cell)
    return now > frame or (now == frame and there >= rows)


@compiled
def wait_for_rows(
    progress: Any, frame_cell: Any, rows_cell: Any, frame: Any, rows: Any, control: Any, stop_cell: Any
) -> Any:
    """Wait until the rows are there, or `control[stop_cell]` is not 0; return whether they are there."""
    while True:
        for _ in range(LOOKS_BETWEEN_STOPS):
            if rows_are_there(progress, frame_cell, rows_cell, frame, rows):
                return True
            breathe()
        if look_at(control, stop_cell) != 0:
            return False


def measure(source: Any, task: Any, start: Any, stop: Any, scratch: Any, slopes: Any, stages: Any) -> None:
    """Stand for the compiled function that measures groups, which `streamed` puts in its place."""


def stream_groups(
    arrival: Any,
    frame: Any,
    last_rows: Any,
    source: Any,
    task: Any,
    start: Any,
    stop: Any,
    scratch: Any,
    slopes: Any,
    stages: Any,
) -> Any:
    """Measure the groups [start, stop) of a frame while it arrives.

    Parameters
    ----------
    arrival : Arrival
    frame : int
        Number of the frame to measure.
    last_rows : (n_groups,) int64
        Rows of the frame that each group needs.
    source, task, scratch, slopes, stages
        See `groups.measure_groups`.

    Returns
    -------
    int
        First group that was not measured: `stop` unless waiting was ended.
    """
    for item in range(start, stop):
        if not wait_for_rows(
            arrival.cells,
            arrival.frame_cell,
            arrival.rows_cell,
            frame,
            last_rows[item],
            arrival.control,
            arrival.stop_cell,
        ):
            return item
        measure(source, task, item, item + 1, scratch, slopes, stages)
    return stop


@cache
def streamed(kernel: Any) -> Any:
    """Return `stream_groups` for a compiled function that measures groups; see `groups.copied`."""
    return copied(stream_groups, kernel, measure=kernel)
