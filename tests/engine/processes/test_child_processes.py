"""Processes that end with the one that has started them; which live, and how they are scheduled."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from uuid import uuid4

import pytest
from tests.engine.commands import start
from tests.patience import LIMIT_S, wait_for
from tests.refusals import refused

from faintspot.engine.processes.child_processes import ChildProcesses, real_time
from faintspot.engine.processes.segment import process_age_s, process_lives, process_start

pytest.importorskip("pyshmem")


pytestmark = pytest.mark.slow

# A bridge waits for a stream that never comes.
PARENT = """
import sys, time
from pathlib import Path
from faintspot.engine.processes.child_processes import ChildProcesses
processes = ChildProcesses(Path(sys.argv[1]))
processes.start("bridge", ["realtime", "bridge", sys.argv[2], "--name", sys.argv[2]])
print(processes._started["bridge"].pid, flush=True)
time.sleep(600)
"""


def state(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return ""


def lives(pid: int) -> bool:
    return state(pid) not in ("", "Z")  # nobody asks for what is left of it


def test_they_end_where_this_one_is_killed(tmp_path: Path) -> None:
    parent = start(PARENT, str(tmp_path), f"fs_test_{uuid4().hex[:12]}")
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    assert lives(child)
    parent.kill()
    parent.communicate(timeout=LIMIT_S)
    wait_for(lambda: not lives(child))


def test_one_that_ends_says_why_and_all_others_end(tmp_path: Path) -> None:
    name = f"fs_test_{uuid4().hex[:12]}"
    with ChildProcesses(tmp_path) as processes:
        processes.start("bridge", ["realtime", "bridge", name, "--name", name])
        processes.check()
        with refused("rain", "0.05 s"):
            processes.wait_until(lambda: False, "rain", 0.05)
        processes.start("run", ["realtime", "run", "--config", str(tmp_path / "nothing.toml")])
        with refused("run", "nothing.toml"):
            processes.wait_until(lambda: False, "run", LIMIT_S)
        bridge = processes._started["bridge"]
    assert bridge.returncode is not None
    assert not processes._started
    assert (tmp_path / "bridge.log").stat().st_mode & 0o077 == 0


def test_one_that_has_done_its_work_may_be_absent(tmp_path: Path) -> None:
    with ChildProcesses(tmp_path) as processes:
        processes.start("list", ["estimators"])
        wait_for(lambda: processes.finished("list"))
        processes.check()
        processes.start("wrong", ["estimators", "nothing"])
        with refused("wrong"):
            wait_for(lambda: processes.finished("wrong"))
        processes.check()


def test_one_that_does_not_end_is_killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("faintspot.engine.processes.child_processes._PATIENCE_S", 0.1)
    with ChildProcesses(tmp_path) as processes:
        processes.start("bridge", ["realtime", "bridge", "fs_test_none", "--name", "fs_test_none"])
        process = processes._started["bridge"]
        process.send_signal(signal.SIGSTOP)  # so that it cannot be asked
        wait_for(lambda: state(process.pid) == "T")
    assert process.returncode == -signal.SIGKILL


def test_which_processes_live_and_how_old_they_are() -> None:
    """To the clock tick, 10 ms, in which starts are counted."""
    mine = process_start(os.getpid())
    assert process_lives(os.getpid(), mine)
    assert not process_lives(os.getpid(), mine + 1)  # the number was used again
    begin = time.monotonic()
    with subprocess.Popen(["sleep", "60"]) as process:
        time.sleep(0.1)
        age = process_age_s(process.pid)
        assert 0.1 - 0.02 <= age <= time.monotonic() - begin + 0.02
        process.kill()
    assert process_start(process.pid) == process_age_s(process.pid) == -1
    assert not process_lives(process.pid, -1)


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


def test_a_thread_that_ends_while_it_is_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    ended = threading.Thread(target=int)
    ended.start()
    ended.join()
    assert ended.native_id is not None
    threads = [threading.get_native_id(), ended.native_id]
    monkeypatch.setattr("faintspot.engine.processes.child_processes._threads", lambda: threads)
    with real_time() as refused:
        assert refused == []


def test_the_lowest_priority() -> None:
    code = (
        "import os; from faintspot.engine.processes.child_processes import low_priority; low_priority();"
        "print(os.sched_getscheduler(0) == os.SCHED_BATCH, os.nice(0))"
    )
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert shown.stdout.split() == ["True", "19"]
