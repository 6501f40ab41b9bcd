from __future__ import annotations

import threading
from typing import Any

import numpy as np
import pytest

from faintspot.kernels.host import lanes_for
from faintspot.kernels.parallel import available_cpus, run_groups


@pytest.mark.parametrize("threads", [None, 1, 2, 5])
@pytest.mark.parametrize("n_groups", [1, 15, 16, 33, 1000])
def test_every_group_once(n_groups: int, threads: int | None) -> None:
    done, lock, names = np.zeros(n_groups, int), threading.Lock(), set()

    def job(start: int, stop: int, scratch: Any) -> None:
        with lock:
            done[start:stop] += 1
            names.add(threading.current_thread().name)

    run_groups(job, n_groups, lanes_for(np.float32, 4), (4, 5), threads)
    assert np.all(done == 1)
    assert len(names) <= (threads or available_cpus())


def test_errors_come_out() -> None:
    def job(start: int, stop: int, scratch: Any) -> None:
        raise RuntimeError("broken")

    for threads in (1, 2):
        with pytest.raises(RuntimeError, match="broken"):
            run_groups(job, 100, lanes_for(np.float32, 4), (4, 4), threads)


def test_scratch_is_of_each_thread_and_fits_the_window() -> None:
    used: dict[int, Any] = {}
    barrier = threading.Barrier(2)

    def job(start: int, stop: int, scratch: Any) -> None:
        used[start] = scratch
        barrier.wait(timeout=30)  # both at once, hence on two threads

    run_groups(job, 100, lanes_for(np.float32, 4), (6, 5), 2)
    first, second = used.values()
    assert first[0].size == second[0].size == 6 * 5 * 4
    assert not any(np.shares_memory(a, b) for a in first for b in second)
