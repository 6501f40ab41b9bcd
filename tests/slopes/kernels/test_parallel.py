import os
import subprocess
import sys
import threading
from typing import Any

import numpy as np
import pytest
from tests.patience import LIMIT_S

from faintspot.slopes.kernels.host import lanes_for
from faintspot.slopes.kernels.parallel import available_cpus, run_groups

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("threads", [None, 1, 2, 5])
@pytest.mark.parametrize("n_groups", [1, 15, 16, 33, 1000])
def test_every_group_once(n_groups: int, threads: int | None) -> None:
    done, lock, names = np.zeros(n_groups, int), threading.Lock(), set()

    def job(start: int, stop: int, scratch: Any) -> None:
        with lock:
            done[start:stop] += 1
            names.add(threading.current_thread().name)

    run_groups(job, n_groups, lanes_for(np.float32, 4), (4, 5), threads, cost=100.0)
    assert np.all(done == 1)
    assert len(names) <= (threads or available_cpus())


def test_errors_come_out() -> None:
    def job(start: int, stop: int, scratch: Any) -> None:
        raise RuntimeError("broken")

    for threads in (1, 2):
        with pytest.raises(RuntimeError, match="broken"):
            run_groups(job, 100, lanes_for(np.float32, 4), (4, 4), threads, cost=100.0)


@pytest.mark.parametrize(
    ("n_groups", "side", "cost", "shares"),
    [(76, 8, 0.2, 1), (290, 8, 0.2, 5), (76, 16, 0.7, 8), (3, 32, 100.0, 3), (1, 32, 100.0, 1)],
)
def test_threads_are_woken_for_enough_work_only(n_groups: int, side: int, cost: float, shares: int) -> None:
    """Groups of 16 sub-apertures; at least 50 us for each of up to 8 threads."""
    starts: list[int] = []

    def job(start: int, stop: int, scratch: Any) -> None:
        starts.append(start)

    run_groups(job, n_groups, lanes_for(np.float32, 16), (side, side), 8, cost=cost)
    assert len(starts) == shares


def test_scratch_is_of_each_thread_and_fits_the_window() -> None:
    used: dict[int, Any] = {}
    barrier = threading.Barrier(2)

    def job(start: int, stop: int, scratch: Any) -> None:
        used[start] = scratch
        barrier.wait(timeout=30)  # both at once, hence on two threads

    run_groups(job, 100, lanes_for(np.float32, 4), (6, 5), 2, cost=100.0)
    first, second = used.values()
    # One vector more than pixels: reading a pixel's right neighbour never leaves the memory.
    assert first.image.size == second.image.size == (6 * 5 + 1) * 4
    assert first.spare.size == 6 * 5 * 4
    assert not any(np.shares_memory(a, b) for a in memory_of(first) for b in memory_of(second))


def memory_of(scratch: Any) -> list[Any]:
    """Every array of a scratch, the estimator's own ones, too."""
    *common, own = scratch
    return [*common, *own]


def test_scratch_is_kept_until_the_shape_of_the_work_changes() -> None:
    used: list[Any] = []

    def job(start: int, stop: int, scratch: Any) -> None:
        used.append(scratch)

    for window in ((6, 5), (6, 5), (6, 6)):
        run_groups(job, 1, lanes_for(np.float32, 4), window, 1)
    assert used[0] is used[1]
    assert used[2].spare.size == 6 * 6 * 4


_FORKED = """
import multiprocessing, threading, warnings
import numpy as np
from faintspot import Layout, Settings, SlopePipeline

warnings.simplefilter("ignore")  # Python 3.12 warns of forks in a process with threads
layout = Layout.grid((60, 60), pixels=8)
frame = np.random.default_rng(1).poisson(3, layout.frame_shape).astype(np.float32)
pipeline = SlopePipeline(layout, Settings("tv", noise_std=3.0, keep_brightest=20), threads=2)
before = pipeline(frame).vector
assert threading.active_count() > 1
fork = multiprocessing.get_context("fork")
answer = fork.Queue()
process = fork.Process(target=lambda: answer.put(pipeline(frame).vector))
process.start()
found = answer.get(timeout=60)
process.join()
assert process.exitcode == 0
assert np.array_equal(found, before)
assert np.array_equal(pipeline(frame).vector, before)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="a system without fork")
def test_a_process_that_forks_after_its_threads_have_worked() -> None:
    """The child has none of the threads, and makes its own."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    command = [sys.executable, "-c", _FORKED]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=2 * LIMIT_S)
    assert done.returncode == 0, done.stderr
