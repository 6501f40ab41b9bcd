"""Why a frame was late or lost: what happened to the engine's thread since the frame before."""

from __future__ import annotations

import resource

IN_TIME, PREPARING, PAGE_FAULT, PREEMPTED, BLOCKED, WOKEN_LATE, OTHER, INCOMPLETE, WORKER = range(9)
CAUSES = (
    "in time",
    "settings prepared",
    "page fault",
    "preempted",
    "blocked",
    "woken late",
    "other",
    "incomplete",
    "worker died",
)
"""Causes in words, by their numbers. The first one that applies is named.

Settings were being prepared in the same process; a page of memory was missing; the scheduler gave the
processor to another program; another thread of the process held Python's interpreter lock; the thread woke
up after the rows were there. "other" includes long computations, worker threads that were preempted, and a
hypervisor that took the processor away. Lost frames only: the camera began the next frame before its last
row, or a worker died."""


class Lateness:
    """Counters of the calling thread, read once per frame; a microsecond each time."""

    def __init__(self) -> None:
        self._before = 0, 0, 0, 0

    def cause(self, late: bool, preparing: bool, woken_late: int, sleeps: int) -> int:
        """Return the number of the cause in `CAUSES` for a frame that was just published or lost.

        Parameters
        ----------
        late : bool
            Whether it was late or lost; the cause is 0 if not.
        preparing : bool
            Whether settings were being prepared.
        woken_late : int
            How often the thread has woken up after the rows were there.
        sleeps : int
            How often the thread has slept; other waits of the thread are for locks.
        """
        usage = resource.getrusage(resource.RUSAGE_THREAD)
        faults, waits = usage.ru_minflt + usage.ru_majflt, usage.ru_nvcsw - sleeps
        now = faults, usage.ru_nivcsw, waits, woken_late
        grown = [after > before for after, before in zip(now, self._before, strict=True)]
        self._before = now
        return PREPARING + (preparing, *grown, True).index(True) if late else IN_TIME
