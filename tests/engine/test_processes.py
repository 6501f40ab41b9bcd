"""Which processes live."""

import os
import subprocess
import time

import pytest

from faintspot.engine.processes.segment import process_age_s, process_lives, process_start

pytestmark = pytest.mark.slow


def test_which_processes_live() -> None:
    mine = process_start(os.getpid())
    assert process_lives(os.getpid(), mine)
    assert not process_lives(os.getpid(), mine + 1)  # the number was used again
    ended = subprocess.Popen(["true"])
    ended.wait()
    assert process_start(ended.pid) == -1
    assert not process_lives(ended.pid, -1)


def test_how_old_a_process_is() -> None:
    """To the clock tick, 10 ms, in which starts are counted."""
    begin = time.monotonic()
    with subprocess.Popen(["sleep", "60"]) as process:
        time.sleep(0.1)
        age = process_age_s(process.pid)
        assert 0.1 - 0.02 <= age <= time.monotonic() - begin + 0.02
        process.kill()
    assert process_age_s(process.pid) == -1.0
