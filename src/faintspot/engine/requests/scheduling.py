"""Real-time scheduling of a process: reserved processors, priority, locked memory, no garbage collection."""

from __future__ import annotations

import ctypes
import gc
import os
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress

_LOCK_CURRENT_AND_FUTURE = 3  # MCL_CURRENT | MCL_FUTURE
_SWITCH_S = 20e-6
_NICEST = 19


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


def lowest_priority() -> None:
    """Leave the processor to others, also where the process was started with real-time priority."""
    os.setpriority(os.PRIO_PROCESS, 0, _NICEST)
    if hasattr(os, "sched_setscheduler"):
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))  # pushes nobody aside when it wakes


@contextmanager
def real_time(cpus: Sequence[int] | None = None, priority: int = 0) -> Iterator[list[str]]:
    """Run with real-time scheduling within a context.

    Parameters
    ----------
    cpus : sequence of int, optional
        Processors that this thread runs on. Default: all that the process may use.
    priority : int
        Priority of SCHED_FIFO, 1 to 99, of all threads of the process; 0 leaves the scheduler and memory
        locking unchanged. A thread without it that holds Python's interpreter lock may lose the processor to
        another program, and a thread that measures then waits for both.

    Yields
    ------
    list of str
        Settings that were not permitted, one line each.
    """
    refused: list[str] = []
    before = os.sched_getaffinity(0) if cpus else None
    policies = {thread: (os.sched_getscheduler(thread), os.sched_getparam(thread)) for thread in _threads()}
    if cpus:
        try:
            os.sched_setaffinity(0, cpus)
        except OSError as error:
            refused.append(f"processors {', '.join(map(str, cpus))}: {error.strerror}")
    if priority:
        try:
            for thread in _threads():
                with suppress(ProcessLookupError):  # it has ended
                    os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(priority))
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
            for thread in _threads():
                with suppress(ProcessLookupError):
                    os.sched_setscheduler(thread, *policies.get(thread, policies[threading.get_native_id()]))
        if before is not None:
            os.sched_setaffinity(0, before)


def _threads() -> list[int]:
    """Return the threads of this process; 0, the calling one, where the system does not list them."""
    try:
        return [int(name) for name in os.listdir("/proc/self/task")]
    except OSError:
        return [0]
