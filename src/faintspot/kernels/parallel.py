"""Sharing the groups of a job among threads, each with scratch memory of its own."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any

import numpy as np

from faintspot.kernels import brightest, spot_numbers, total_variation
from faintspot.kernels.host import aligned_zeros
from faintspot.kernels.simd import Lanes
from faintspot.kernels.sweeps import STATE_VECTORS

_FEWEST_GROUPS = 16  # a thread with less to do costs more than it saves
_local = threading.local()


def available_cpus() -> int:
    """Number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@cache
def _pool(process: int, threads: int) -> ThreadPoolExecutor:
    """Long-lived threads; a forked process gets its own."""
    return ThreadPoolExecutor(threads, thread_name_prefix="faintspot")


def new_scratch(lanes: Lanes, ny: int, nx: int) -> tuple[Any, ...]:
    """Scratch memory for one thread: image, output, state, rows, numbers, counts, lane counts."""
    width, pixels = lanes.width, ny * nx
    return (
        aligned_zeros(pixels * width, lanes.dtype),
        aligned_zeros(pixels * width, lanes.dtype),
        aligned_zeros(STATE_VECTORS * pixels * width, lanes.dtype),
        aligned_zeros((pixels + 2 * nx + 3) * width, lanes.dtype),
        aligned_zeros((total_variation.LANE_ROWS + brightest.LANE_ROWS) * width, lanes.dtype),
        np.zeros(total_variation.COUNT_ROWS * width, np.int64),
        np.zeros(3 * width, np.int64),
    )


def new_spot_scratch(lanes: Lanes, ny: int, nx: int, rank: int, taps: int, positions: int) -> tuple[Any, ...]:
    """Scratch memory for one thread of `located.locate_groups`.

    Image, smoothed image, taps, numbers, profiles, rows, logarithms of the posterior, lane counts.
    """
    width, pixels = lanes.width, ny * nx
    vectors = -(-nx // width)
    padded = -(-max(ny, nx) // width) * width
    return (
        aligned_zeros((pixels + 1) * width, lanes.dtype),
        aligned_zeros(pixels * width, lanes.dtype),
        aligned_zeros(2 * taps * width, lanes.dtype),
        aligned_zeros(spot_numbers.LANE_ROWS * width, lanes.dtype),
        aligned_zeros(4 * rank * padded * width, lanes.dtype).reshape(2, rank, 2, padded, width),
        aligned_zeros(ny * vectors * width * width, lanes.dtype).reshape(ny, vectors, width, width),
        np.zeros(positions),
        np.zeros(5 * width, np.int64),
    )


def _thread_scratch(make: Callable[..., tuple[Any, ...]], arguments: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return the scratch of the calling thread, made anew only when the shape of the work changes."""
    key = (make, arguments)
    if getattr(_local, "key", None) != key:
        _local.scratch = make(*arguments)
        _local.key = key
    return _local.scratch  # type: ignore[no-any-return]


def run_groups(
    job: Callable[[int, int, tuple[Any, ...]], None],
    n_groups: int,
    lanes: Lanes,
    window: tuple[int, int],
    threads: int | None = None,
    spot_scratch: tuple[int, int, int] | None = None,
) -> None:
    """Call `job(start, stop, scratch)` so that every group is done once, on up to `threads` threads.

    The scratch is that of `new_scratch`, or of `new_spot_scratch` with `spot_scratch`: rank, taps, positions.
    """
    wanted = available_cpus() if threads is None else threads
    shares = max(1, min(wanted, n_groups // _FEWEST_GROUPS))
    make: Callable[..., tuple[Any, ...]] = new_scratch if spot_scratch is None else new_spot_scratch
    arguments = (lanes, *window, *(spot_scratch or ()))

    def work(share: int) -> None:
        start, stop = n_groups * share // shares, n_groups * (share + 1) // shares
        job(start, stop, _thread_scratch(make, arguments))

    others = [_pool(os.getpid(), wanted).submit(work, share) for share in range(1, shares)]
    work(0)  # the caller is awake already
    for other in others:
        other.result()
