"""Real-time scheduling of a process: reserved processors, priority, locked memory, no garbage collection."""

from __future__ import annotations

import ctypes
import gc
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

_LOCK_CURRENT_AND_FUTURE = 3  # MCL_CURRENT | MCL_FUTURE
_SWITCH_S = 20e-6


@contextmanager
def quick_switching(seconds: float = 50e-6) -> Iterator[None]:
    """Shorten the interval at which threads of this process take turns, from 5 ms, within a context.

    A thread that reads, compiles or checks then delays one that measures or publishes by no more than that.
    """
    before = sys.getswitchinterval()
    sys.setswitchinterval(seconds)
    try:
        yield
    finally:
        sys.setswitchinterval(before)


@contextmanager
def real_time(cpus: Sequence[int] | None = None, priority: int = 0) -> Iterator[list[str]]:
    """Run with real-time scheduling within a context.

    Parameters
    ----------
    cpus : sequence of int, optional
        Processors to run on. Default: all that the process may use.
    priority : int
        Priority of SCHED_FIFO, 1 to 99; 0 leaves the scheduler and memory locking unchanged.

    Yields
    ------
    list of str
        Settings that were not permitted, one line each.
    """
    refused: list[str] = []
    before = os.sched_getaffinity(0) if cpus else None
    policy = os.sched_getscheduler(0), os.sched_getparam(0)
    if cpus:
        try:
            os.sched_setaffinity(0, cpus)
        except OSError as error:
            refused.append(f"processors {', '.join(map(str, cpus))}: {error.strerror}")
    if priority:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        except OSError as error:
            refused.append(f"real-time priority {priority}: {error.strerror}")
        if ctypes.CDLL(None, use_errno=True).mlockall(_LOCK_CURRENT_AND_FUTURE):
            refused.append(f"locked memory: {os.strerror(ctypes.get_errno())}")
    collecting = gc.isenabled()
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        with quick_switching(_SWITCH_S):
            yield refused
    finally:
        if collecting:
            gc.enable()
        gc.unfreeze()
        if priority:
            ctypes.CDLL(None).munlockall()
            os.sched_setscheduler(0, *policy)
        if before is not None:
            os.sched_setaffinity(0, before)
