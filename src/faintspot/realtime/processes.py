"""Whether the process that made a shared-memory segment is still the one that has its number."""

from __future__ import annotations

import os
import time
from pathlib import Path


def process_start(pid: int) -> int:
    """Return when a process started, in clock ticks since boot; -1 when there is none or it is dead.

    Process numbers are used again; number and start together are not. A killed process that its parent has
    not yet asked for (a zombie) is dead. See proc_pid_stat(5), fields 3 and 22.
    """
    try:
        # Of its first thread, which is the same: qemu-user makes up /proc/PID/stat for the process itself.
        text = Path(f"/proc/{pid}/task/{pid}/stat").read_text(encoding="ascii", errors="replace")
    except OSError:
        return -1
    # The second field is the program's name in parentheses, which may hold blanks and parentheses.
    fields = text.rpartition(")")[2].split()
    return -1 if fields[0] in "ZXx" else int(fields[19])


def process_lives(pid: int, start: int) -> bool:
    """Whether the process with that number and start is alive."""
    return start >= 0 and process_start(pid) == start


def process_age_s(pid: int) -> float:
    """Return how long ago a process started, s; -1 when there is none or it is dead."""
    start = process_start(pid)
    return -1.0 if start < 0 else time.clock_gettime(time.CLOCK_BOOTTIME) - start / os.sysconf("SC_CLK_TCK")
