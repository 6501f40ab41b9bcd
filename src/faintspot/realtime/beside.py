"""Processes of lowest priority beside a running engine, which goes on whatever happens to them."""

from __future__ import annotations

import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from faintspot.base.errors import InputError
from faintspot.realtime.child_processes import ChildProcesses

ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
NICEST = 19
_WATCH_S = 1.0


@contextmanager
def process_beside(command: str, arguments: Sequence[str], on_fault: Callable[[str], None]) -> Iterator[None]:
    """Run `faintspot realtime COMMAND ARGUMENTS` within a context; `on_fault` takes a line if it ends."""
    done = threading.Event()
    with (
        tempfile.TemporaryDirectory(prefix=f"faintspot-{command}-") as folder,
        ChildProcesses(Path(folder)) as children,
    ):
        children.start(command, ["realtime", command, *arguments], ONE_THREAD)
        watcher = threading.Thread(target=_watch, args=(children, done, on_fault), daemon=True)
        watcher.start()
        try:
            yield
        finally:
            done.set()
            watcher.join()


def _watch(children: ChildProcesses, done: threading.Event, on_fault: Callable[[str], None]) -> None:
    """Wait for the end of the process."""
    while not done.wait(_WATCH_S):
        try:
            children.check()
        except InputError as error:
            if not done.wait(_WATCH_S):  # else the engine has ended, too
                on_fault(f"{error}")
            return
