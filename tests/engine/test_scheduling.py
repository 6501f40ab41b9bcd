"""Scheduling of the engine's process."""

import os
import subprocess
import sys
import threading

import pytest

from faintspot.engine.processes.child_processes import real_time

pytestmark = pytest.mark.skipif(not hasattr(os, "sched_setscheduler"), reason="Linux only")


@pytest.mark.slow
def test_priority_holds_for_threads_that_were_there_before_and_is_given_back() -> None:
    done = threading.Event()
    thread = threading.Thread(target=done.wait)
    thread.start()
    assert thread.native_id is not None
    threads = 0, thread.native_id
    before = [os.sched_getscheduler(each) for each in threads]
    try:
        with real_time(priority=1) as refused:
            if any("priority" in line for line in refused):
                pytest.skip("real-time priority is not permitted")
            assert [os.sched_getscheduler(each) for each in threads] == [os.SCHED_FIFO] * 2
        assert [os.sched_getscheduler(each) for each in threads] == before
    finally:
        done.set()
        thread.join()


@pytest.mark.slow
def test_the_lowest_priority() -> None:
    code = (
        "import os; from faintspot.engine.processes.child_processes import low_priority; low_priority();"
        "print(os.sched_getscheduler(0) == os.SCHED_BATCH, os.nice(0))"
    )
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert shown.stdout.split() == ["True", "19"]
