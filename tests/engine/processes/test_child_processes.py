"""Processes that end with the one that has started them."""

import signal
from pathlib import Path
from uuid import uuid4

import pytest
from tests.engine.commands import start
from tests.patience import LIMIT_S, wait_for
from tests.refusals import refused

from faintspot.base.errors import InputError
from faintspot.engine.processes.child_processes import ChildProcesses

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
        with pytest.raises(InputError, match=r"rain: not ready after 0\.05 s"):
            processes.wait_until(lambda: False, "rain", 0.05)
        processes.start("run", ["realtime", "run", "--config", str(tmp_path / "nothing.toml")])
        with pytest.raises(InputError, match=r"run: the process has ended: .*nothing\.toml: no such file"):
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
        with pytest.raises(InputError, match="wrong: the process has ended"):
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


def test_a_folder_that_is_none(tmp_path: Path) -> None:
    with refused("cannot be written"):
        ChildProcesses(tmp_path / "none").start("run", ["realtime", "run"])
