"""Driver of kernels that read sub-apertures from the rows of the frame, without copying pixels."""

from __future__ import annotations

from typing import Any

from faintspot.slopes.kernels.compilation.simd import width_of
from faintspot.slopes.kernels.compilation.subnormals import flush_subnormals, restore_control
from faintspot.slopes.kernels.driver.groups import Task, copied


def rows_driver_of(measure: Any, measure_groups: Any) -> Any:
    """Return `measure_rows`, compiled with an estimator's own kernels.

    Parameters
    ----------
    measure : kernel
        Measures one sub-aperture; returns False, and writes nothing, where it has bad pixels.
    measure_groups : kernel
        Measures groups with bad pixels, from `tables.gathered`; see `groups.driver_of`.
    """
    return copied(measure_rows, measure, measure=measure, measure_groups=measure_groups)


def measure(source: Any, tables: Any, f: Any, s: Any, settings: Any, slopes: Any) -> Any:
    """Placeholder for the kernel of one sub-aperture."""


def measure_groups(
    source: Any, task: Any, start: Any, stop: Any, scratch: Any, slopes: Any, stages: Any
) -> None:
    """Placeholder for the kernel of groups with bad pixels."""


def measure_rows(
    source: Any, task: Any, start: Any, stop: Any, scratch: Any, slopes: Any, stages: Any
) -> None:
    """Compute the slopes of the groups [start, stop) of a block of frames; see `groups.measure_groups`."""
    width = width_of(source.lanes)
    n = source.corners.shape[0]
    n_groups = (n + width - 1) // width
    control = flush_subnormals()
    for item in range(start, stop):
        f, group = item // n_groups, item % n_groups
        first, last = group * width, min((group + 1) * width, n)
        settings = task.settings[task.variants[f]]
        whole = stages.shape[0] == 0
        for s in range(first, last):
            whole = measure(source, task.tables, f, s, settings, slopes) and whole
        if whole:
            continue
        filled = Task(task.settings, task.variants, task.prior, task.tables.gathered, task.variances)
        measure_groups(source, filled, item, item + 1, scratch, slopes, stages)
        for s in range(first, last):  # those without bad pixels once more: slopes depend on no neighbour
            measure(source, task.tables, f, s, settings, slopes)
    restore_control(control)
