"""Sharing the groups of a job among threads, each with scratch memory of its own."""

import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any

from faintspot.slopes.kernels.groups import Scratch, new_scratch
from faintspot.slopes.kernels.positions.gravity import gravity_scratch
from faintspot.slopes.kernels.simd import Lanes

_FEWEST_US = 50.0  # of work for a thread: waking one takes about 30 us
_US_OF_COST = 1.2  # that a sub-aperture of 16 x 16 px takes whose `cost` is 1
_REMEMBERED = 2
_local = threading.local()


def available_cpus() -> int:
    """Number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@cache
def _pool(process: int, threads: int) -> ThreadPoolExecutor:
    """Long-lived threads; a forked process gets its own."""
    return ThreadPoolExecutor(threads, thread_name_prefix="faintspot")


OwnScratch = Callable[[Lanes, int, int], tuple[Any, ...]]
"""Makes the own memory of an estimator's kernel, for lanes and a window of ny x nx pixels."""


def thread_scratch(lanes: Lanes, window: tuple[int, int], own: OwnScratch) -> Scratch:
    """Return the scratch of the calling thread, made anew only when the shape of the work changes.

    Two shapes are remembered: a pipeline may look at the flux of a frame before it measures it.
    """
    key = (lanes, window, own)
    known: dict[Any, Scratch] = vars(_local).setdefault("known", {})
    if key not in known:
        while len(known) >= _REMEMBERED:
            known.pop(next(iter(known)))
        known[key] = new_scratch(lanes, *window, own(lanes, *window))
    return known[key]


def most_threads(n_groups: int, lanes: Lanes, window: tuple[int, int], cost: float) -> int:
    """Return the number of threads above which each would have too little to do."""
    work_us = n_groups * lanes.width * cost * _US_OF_COST * window[0] * window[1] / 256
    return min(int(work_us / _FEWEST_US), n_groups)


def run_groups(
    job: Callable[[int, int, Scratch], None],
    n_groups: int,
    lanes: Lanes,
    window: tuple[int, int],
    threads: int | None = None,
    own_scratch: OwnScratch = gravity_scratch,
    cost: float = 1.0,
) -> None:
    """Call `job(start, stop, scratch)` so that every group is done once, on up to `threads` threads.

    `cost`: of a sub-aperture, as `Estimator.cost`. Threads that would have too little to do are not woken.
    """
    most = most_threads(n_groups, lanes, window, cost)
    if most < 2 or threads == 1:
        job(0, n_groups, thread_scratch(lanes, window, own_scratch))
        return
    wanted = available_cpus() if threads is None else threads
    shares = min(wanted, most)

    def work(share: int) -> None:
        start, stop = n_groups * share // shares, n_groups * (share + 1) // shares
        job(start, stop, thread_scratch(lanes, window, own_scratch))

    others = [_pool(os.getpid(), wanted).submit(work, share) for share in range(1, shares)]
    work(0)  # the caller is awake already
    for other in others:
        other.result()
