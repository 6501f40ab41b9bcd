"""Which processes live."""

from __future__ import annotations

import os
import subprocess

from faintspot.realtime.processes import process_lives, process_start


def test_which_processes_live() -> None:
    mine = process_start(os.getpid())
    assert process_lives(os.getpid(), mine)
    assert not process_lives(os.getpid(), mine + 1)  # the number was used again
    ended = subprocess.Popen(["true"])
    ended.wait()
    assert process_start(ended.pid) == -1
    assert not process_lives(ended.pid, -1)
