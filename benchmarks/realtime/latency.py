"""The tail of the latency: how long the real-time path takes for a frame that is there, frame after frame.

The engine's own frame path and workers, on threads pinned to one processor each, with what the engine does
to be left alone (no garbage collector, short turns of the interpreter's lock), but without a real-time
priority, streams and camera: what is measured is one call for each frame, all of whose rows are there, back
to back. The frames have spots and noise, the denoising a fixed number of iterations, so that all take
equally long but for what disturbs them.

That is told beside: how often the scheduler took the processor away from the measuring threads ("switched
out", the kernel's count of involuntary context switches of each thread), and, on one thread, the same
quantiles of those frames alone during which it did not happen ("undisturbed"). What a hypervisor or a
neighbour on the same physical core takes is in neither count.
"""

import os
import resource
import threading
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.frames.rivals import problem
from benchmarks.frames.scale import settings, settings_in_words
from benchmarks.measuring import Row, Table, spread
from faintspot.engine.frames.frame_path import FramePath, Progress
from faintspot.engine.frames.workers import Workers
from faintspot.engine.processes.child_processes import real_time
from faintspot.slopes.kernels.parallel import available_cpus

FRAMES = {36: 40_000, 1208: 5_000}
FEWEST = 1000  # frames that say something about p99.9
UNDISTURBED = "undisturbed"
SLOTS = 4
_QUANTILES = {"p50": 0.5, "p99": 0.99, "p99.9": 0.999}
_LEVELS = np.unique(np.concatenate([np.logspace(0, -5, 61), [0.5, 0.01, 0.001]]))[::-1]

Floats = NDArray[np.float64]


def switches_of(thread: int) -> int:
    """How often the scheduler has taken the processor away from a thread of this process."""
    status = Path(f"/proc/self/task/{thread}/status").read_text()
    return int(status.partition("nonvoluntary_ctxt_switches:")[2].split()[0])


def quantile_columns(latencies_us: Floats) -> dict[str, float]:
    """Return the quantiles, their ratio, and the largest, us."""
    columns = {name: float(np.quantile(latencies_us, level)) for name, level in _QUANTILES.items()}
    return {**columns, "max": float(latencies_us.max()), "p99.9/p50": columns["p99.9"] / columns["p50"]}


def spread_of_tail(latencies_us: Floats) -> float:
    """Return the relative standard error of p99.9 / p50."""
    return spread({"us": latencies_us}, lambda part: quantile_columns(part["us"])["p99.9/p50"])


def _measure(path: FramePath, frames: int) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the time of each frame, us, and whether the caller was switched out meanwhile."""
    times, switches = np.zeros(frames), np.zeros(frames + 1, np.int64)
    for index in range(frames // 20):  # until everything is in the caches
        path.measure(0, index % SLOTS)
    switches[0] = resource.getrusage(resource.RUSAGE_THREAD).ru_nivcsw
    for index in range(frames):
        start = time.perf_counter_ns()
        path.measure(0, index % SLOTS)
        times[index] = time.perf_counter_ns() - start
        switches[index + 1] = resource.getrusage(resource.RUSAGE_THREAD).ru_nivcsw
    return times / 1e3, np.diff(switches) > 0


def _run(n: int, threads: int) -> Row:
    """Measure the frames of one sensor on so many pinned threads."""
    case, frames = problem(n, **settings()), FRAMES[n]
    slots = np.repeat(case.frame[None], SLOTS, axis=0)
    rows = np.array([0, len(case.frame)], np.int64)
    cpus = sorted(os.sched_getaffinity(0))[-threads:]
    before = {thread.native_id for thread in threading.enumerate()}
    # A worker takes processor number % count: the first worker the second, the caller the first.
    workers = Workers(threads - 1, cpus) if threads > 1 else None
    path = FramePath(case.pipeline, slots, Progress(rows, 0, 1), workers=workers)
    path.warm_up()
    try:
        with real_time(cpus[:1]):
            mine = [threading.get_native_id()]
            mine += [t.native_id for t in threading.enumerate() if t.native_id and t.native_id not in before]
            start = sum(map(switches_of, mine))
            latencies, disturbed = _measure(path, frames)
            switched_out = sum(map(switches_of, mine)) - start
    finally:
        if workers is not None:
            workers.close()
    name = f"{n} of 16 x 16, {threads} thread{'s' if threads > 1 else ''}"
    columns = {"frames": float(frames), "switched out": float(switched_out), **quantile_columns(latencies)}
    known = {"p99.9/p50": spread_of_tail(latencies)}
    calm = latencies[~disturbed]
    if threads == 1 and len(calm) >= FEWEST:
        quantiles = quantile_columns(calm)
        columns |= {f"{UNDISTURBED} {column}": quantiles[column] for column in ("p99.9", "p99.9/p50")}
        known[f"{UNDISTURBED} p99.9/p50"] = spread_of_tail(calm)
    return Row(name, columns, spread=known, better="lower")


def run() -> list[Table]:
    """Measure a small sensor on one thread, and a large one on one and two."""
    title = "One frame through the real-time path, us"
    if not hasattr(os, "sched_setaffinity"):
        return [Table("latency", title, [], ["Linux only: threads cannot be pinned here"])]
    cases = [(36, 1), (1208, 1)] + ([(1208, 2)] if available_cpus() > 1 else [])
    rows = [_run(*case) for case in cases]
    return [Table("latency", title, rows, [f"{settings_in_words()}; {available_cpus()} processors"])]
