"""Check whether the process that made a shared-memory segment is still alive."""

from __future__ import annotations

import os
import time
from pathlib import Path


def process_start(pid: int) -> int:
    """Return when a process started, in clock ticks since boot; -1 if it does not exist or is dead.

    Process ids are reused; the pair of id and start time is not. A zombie, i.e. a killed process that its
    parent has not waited for, counts as dead. See proc_pid_stat(5), fields 3 and 22.
    """
    try:
        # The first thread's file holds the same: qemu-user makes up /proc/PID/stat for the process itself.
        text = Path(f"/proc/{pid}/task/{pid}/stat").read_text(encoding="ascii", errors="replace")
    except OSError:
        return -1
    # The second field is the program's name in parentheses, which may contain blanks and parentheses.
    fields = text.rpartition(")")[2].split()
    return -1 if fields[0] in "ZXx" else int(fields[19])


def process_lives(pid: int, start: int) -> bool:
    """Return whether the process with that id and start time is alive."""
    return start >= 0 and process_start(pid) == start


def process_age_s(pid: int) -> float:
    """Return how long ago a process started [s]; -1 if it does not exist or is dead."""
    start = process_start(pid)
    return -1.0 if start < 0 else time.clock_gettime(time.CLOCK_BOOTTIME) - start / os.sysconf("SC_CLK_TCK")
