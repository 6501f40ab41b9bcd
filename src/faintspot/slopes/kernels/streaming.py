"""Slopes of a frame while it arrives: every group of sub-apertures as soon as its last row is there.

The camera's process writes rows into shared memory and then says how many are there. Waiting for them happens
inside the compiled code, without Python: nothing lies between the arrival of a row and the work on it.

A thread sleeps until shortly before the rows of its next group are due, then polls. The kernel takes the
processor away from real-time threads that never sleep, for 5 % of each second where others want it. When rows
are due is learnt from the frames, as a time after the last row of the frame before.

Of the product of a reconstructor with the slopes, as much is computed as the time until rows arrive allows:
groups whose rows are there are measured first.
"""

from typing import Any, NamedTuple

import llvmlite.binding as llvm
from llvmlite import ir
from numba.core import cgutils, types

from faintspot.base.arrays import Array
from faintspot.slopes.kernels.compiling import compiled
from faintspot.slopes.kernels.groups import Scratch, SlopeArrays, Source, Task
from faintspot.slopes.kernels.ordered import look_at, now_ns, sleep_ns
from faintspot.slopes.kernels.products import ProductPart, add_slopes
from faintspot.slopes.kernels.simd import intrinsic, width_of

LOOKS_BETWEEN_STOPS = 1024  # at the progress, between two looks at whether to give up

LAST_ROW, MARGIN, WOKEN_LATE, COLD, SLEEPS, PENDING, PACE_CELLS = range(7)
"""Cells of `Arrival.pace`, and their number. LAST_ROW: time of the last row of the frame before [ns]; 0: not
known, do not sleep. MARGIN: time before rows are due at which a thread wakes up [ns]. WOKEN_LATE: number of
times that rows were there before it woke up. COLD: whether it has slept since the last rehearsal. SLEEPS:
number of times that it has slept. PENDING: first group whose product is to be added."""
SHORTEST_NS = 60_000
_LONGEST_NS = 20_000_000  # so that a stop is noticed
_NAP_NS = 50_000
_GROWTH, _LATE = 4, 200  # a late waking adds 1/4 to the margin; it settles where that is one waking in 200
_SLOWNESS = 8  # rows that come twice as late are believed after some 6 frames


class Arrival(NamedTuple):
    """Number of rows of a frame that have arrived, as written by another process."""

    cells: Array
    """int64 array in shared memory."""
    frame_cell: int
    """Index of the cell with the number of the arriving frame."""
    rows_cell: int
    """Index of the cell with the number of rows that have arrived."""
    control: Array
    """int64 array: waiting ends when the number at `stop_cell` is not 0."""
    stop_cell: int
    pace: Array
    """(PACE_CELLS,) int64, of one thread."""
    due: Array
    """(n_groups,) int64: learnt time from the last row of the frame before to the group's last row, ns."""


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
def rows_are_there(progress: Array, frame_cell: int, rows_cell: int, frame: int, rows: int) -> bool:
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
    progress: Array, frame_cell: int, rows_cell: int, frame: int, rows: int, control: Array, stop_cell: int
) -> bool:
    """Wait until the rows are there, or `control[stop_cell]` is not 0; return whether they are there.

    After a while without rows it sleeps between looks: real-time threads that poll on all processors would
    keep a camera's process from ever writing them.
    """
    begun = now_ns()
    while True:
        for _ in range(LOOKS_BETWEEN_STOPS):
            if rows_are_there(progress, frame_cell, rows_cell, frame, rows):
                return True
            breathe()
        if look_at(control, stop_cell) != 0:
            return False
        if now_ns() - begun > _LONGEST_NS:
            sleep_ns(_NAP_NS)


@compiled
def sleep_until_due(arrival: Arrival, frame: int, rows: int, item: int) -> bool:
    """Sleep until shortly before a group's rows are due; return whether to rehearse before they come.

    That is when the thread has slept since the last rehearsal, and there is time for one.
    """
    pace, due = arrival.pace, arrival.due
    cells = arrival.cells, arrival.frame_cell, arrival.rows_cell
    if pace[LAST_ROW] == 0 or rows_are_there(*cells, frame, rows):
        return False
    # A margin learnt while rows came later would keep the thread from ever sleeping again.
    margin = min(pace[MARGIN], max(due[item] // 2, SHORTEST_NS))
    awake = pace[LAST_ROW] + due[item] - margin
    left = awake - now_ns()
    if left > SHORTEST_NS:
        pace[COLD] = 1
        while left > 0 and look_at(arrival.control, arrival.stop_cell) == 0:
            sleep_ns(min(left, _LONGEST_NS))
            pace[SLEEPS] += 1
            left = awake - now_ns()
        if rows_are_there(*cells, frame, rows):
            pace[WOKEN_LATE] += 1
            pace[MARGIN] = margin + margin // _GROWTH
            due[item] -= due[item] // _SLOWNESS
            return False
        pace[MARGIN] = max(margin - margin // (_GROWTH * _LATE), SHORTEST_NS)
    return pace[COLD] != 0 and left + margin >= SHORTEST_NS


@compiled
def wait_for_group(arrival: Arrival, frame: int, rows: int, item: int) -> bool:
    """Wait for a group's rows, and learn when they come; return whether they are there."""
    cells = arrival.cells, arrival.frame_cell, arrival.rows_cell
    if rows_are_there(*cells, frame, rows):
        return True
    there = wait_for_rows(*cells, frame, rows, arrival.control, arrival.stop_cell)
    if arrival.pace[LAST_ROW] != 0:
        took = now_ns() - arrival.pace[LAST_ROW]
        # Slowly upwards, so that nobody sleeps through the first frames after a pause.
        arrival.due[item] = min(took, arrival.due[item] + arrival.due[item] // _SLOWNESS + SHORTEST_NS)
    return there


@compiled
def multiply_until(
    arrival: Arrival, frame: int, rows: int, item: int, width: int, slopes: SlopeArrays, part: ProductPart
) -> None:
    """Add products of groups before `item`, until the rows are there; of `width` sub-apertures each.

    Parameters
    ----------
    slopes : SlopeArrays
    part : ProductPart
    """
    if part.columns.shape[0] == 0:
        return
    pace, n = arrival.pace, slopes.x.shape[1]
    cells = arrival.cells, arrival.frame_cell, arrival.rows_cell
    while pace[PENDING] < item and not rows_are_there(*cells, frame, rows):
        first = pace[PENDING] * width
        add_slopes(part, slopes.x[0], slopes.y[0], slopes.flags[0], first, min(first + width, n))
        pace[PENDING] += 1


@intrinsic
def _measure_at(
    typing_context: Any,
    address: Any,
    source: Any,
    task: Any,
    start: Any,
    stop: Any,
    scratch: Any,
    slopes: Any,
    stages: Any,
) -> Any:
    """Call the machine code at an address as `groups.measure_groups`; see `compiling.Direct.address`."""
    kinds = (source, task, types.int64, types.int64, scratch, slopes, stages)

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        kind = context.call_conv.get_function_type(types.none, kinds)
        outputs = [cgutils.alloca_once(builder, output.pointee) for output in kind.args[:2]]
        packed = context.get_arg_packer(kinds).as_arguments(builder, args[1:])
        builder.call(builder.inttoptr(args[0], kind.as_pointer()), [*outputs, *packed])
        return context.get_dummy_value()

    return types.void(types.int64, *kinds), emit


@compiled
def stream_groups(
    measure: int,
    arrival: Arrival,
    frame: int,
    last_rows: Array,
    source: Source,
    task: Task,
    start: int,
    stop: int,
    scratch: Scratch,
    slopes: SlopeArrays,
    stages: Array,
    part: ProductPart,
) -> int:
    """Measure the groups [start, stop) of a frame while it arrives, and begin the product with their slopes.

    Parameters
    ----------
    measure : int
        Address of the compiled function that measures groups. That is not made part of this one, which would
        be compiled for every estimator.
    arrival : Arrival
    frame : int
        Number of the frame to measure.
    last_rows : (n_groups,) int64
        Rows of the frame that each group needs.
    source, task, scratch, slopes, stages
        See `groups.measure_groups`.
    part : ProductPart

    Returns
    -------
    int
        First group that was not measured: `stop` unless waiting was ended.
    """
    width = width_of(source.lanes)
    for item in range(start, stop):
        multiply_until(arrival, frame, last_rows[item], item, width, slopes, part)
        sleep_until_due(arrival, frame, last_rows[item], item)
        if not wait_for_group(arrival, frame, last_rows[item], item):
            return item
        _measure_at(measure, source, task, item, item + 1, scratch, slopes, stages)
    return stop
