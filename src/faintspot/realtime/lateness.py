"""Why a frame was late: what the operating system did to the engine's thread since the frame before."""

from __future__ import annotations

import resource

IN_TIME, PREPARING, PAGE_FAULT, PREEMPTED, WOKEN_LATE, OTHER = range(6)
CAUSES = ("in time", "settings prepared", "page fault", "preempted", "woken late", "other")
"""Causes in words, by their numbers. The first one that applies is named: settings were being prepared in the
same process, a page of memory was missing, the scheduler gave the processor to another program, the thread
woke up after the rows were there. "other" includes long computations, worker threads that were preempted, and
a hypervisor that took the processor away."""


class Lateness:
    """Counters of the calling thread, read once per frame; a microsecond each time."""

    def __init__(self) -> None:
        self._faults = self._switches = self._woken = 0

    def cause(self, late: bool, preparing: bool, woken_late: int) -> int:
        """Return the number of the cause in `CAUSES` for a frame that has just been published.

        Parameters
        ----------
        late : bool
            Whether it was late; the cause is 0 if not.
        preparing : bool
            Whether settings were being prepared.
        woken_late : int
            How often the thread has woken up after the rows were there.
        """
        usage = resource.getrusage(resource.RUSAGE_THREAD)
        faults, switches = usage.ru_minflt + usage.ru_majflt, usage.ru_nivcsw
        grown = faults > self._faults, switches > self._switches, woken_late > self._woken
        self._faults, self._switches, self._woken = faults, switches, woken_late
        return PREPARING + (preparing, *grown, True).index(True) if late else IN_TIME
