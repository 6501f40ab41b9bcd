"""Child processes that end with this one, even if it is killed, and scheduling of the engine (Linux)."""

import ctypes
import gc
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from faintspot.base.errors import InputError
from faintspot.base.files import Closing, output_errors

_PATIENCE_S = 10.0  # for a process to end on request
_LOOK_S = 0.02
_DIES_WITH_PARENT = 1  # PR_SET_PDEATHSIG
_ERROR = "faintspot: error: "

ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""Variables of a process that leaves the other cores alone."""


class ChildProcesses(Closing):
    """Commands that run beside this process; a context manager that ends them, the last one first.

    Ctrl-C in the terminal does not reach them, so that they end in order. If this process is killed, the
    kernel ends them.

    Parameters
    ----------
    folder : path
        Folder of the log files NAME.log, readable by this user only.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._started: dict[str, subprocess.Popen[bytes]] = {}

    def start(
        self,
        name: str,
        arguments: Sequence[str],
        environment: Mapping[str, str] | None = None,
        module: str = "faintspot",
    ) -> None:
        """Start `python -m MODULE ARGUMENTS`; the calling thread must live as long as the process is needed.

        Parameters
        ----------
        name : str
        arguments : sequence of str
        environment : mapping, optional
            Variables to set for it.
        module : str
            Default: the command line.

        Raises
        ------
        InputError
            When the log cannot be written.
        """
        library = ctypes.CDLL(None)
        with output_errors(self._log(name)):
            self._log(name).unlink(missing_ok=True)
            log = os.open(self._log(name), os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        try:
            self._started[name] = subprocess.Popen(
                [sys.executable, "-m", module, *arguments],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
                env={**os.environ, **(environment or {})},
                preexec_fn=lambda: library.prctl(_DIES_WITH_PARENT, signal.SIGTERM),
            )
        finally:
            os.close(log)

    def output(self, name: str) -> list[str]:
        """Return the lines that a command has written so far."""
        return self._log(name).read_text(encoding="utf-8", errors="replace").splitlines()

    def check(self) -> None:
        """Check that all processes run.

        Raises
        ------
        InputError
            When one has ended; the message holds its last line.
        """
        for name, process in self._started.items():
            code = process.poll()
            if code is not None:
                words = (self.output(name) or [f"exit code {code}"])[-1] if code >= 0 else f"signal {-code}"
                raise InputError(f"{name}: the process has ended: {words.removeprefix(_ERROR)}")

    def finished(self, name: str) -> bool:
        """Return whether a command has done its work; from its end on it may be absent.

        Raises
        ------
        InputError
            When a process has failed; the message holds its last line.
        """
        process = self._started.get(name)
        try:
            if process is None or process.poll() != 0:
                self.check()
        finally:
            if process is not None and process.returncode is not None:
                del self._started[name]
        return name not in self._started

    def wait_until(self, condition: Callable[[], bool], awaited: str, timeout_s: float) -> None:
        """Wait for a condition that needs all processes.

        Raises
        ------
        InputError
            When a process ends or the time is over; `awaited` names the condition in the message.
        """
        end = time.monotonic() + timeout_s
        while not condition():
            self.check()
            if time.monotonic() > end:
                raise InputError(f"{awaited}: not ready after {timeout_s:g} s")
            time.sleep(_LOOK_S)

    def close(self) -> None:
        """End all processes; kill those that do not end on request."""
        while self._started:
            _, process = self._started.popitem()
            process.terminate()
            try:
                process.wait(_PATIENCE_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def _log(self, name: str) -> Path:
        return self._folder / f"{name}.log"


_LOCK_CURRENT_AND_FUTURE = 3  # MCL_CURRENT | MCL_FUTURE
_SWITCH_S = 20e-6
_NICEST = 19


@contextmanager
def quick_switching(seconds: float = 50e-6) -> Iterator[None]:
    """Shorten the interval at which threads of this process take turns, from 5 ms, within a context.

    A thread that reads, compiles or checks then delays one that measures or publishes by no more than that.
    """
    before = sys.getswitchinterval()
    sys.setswitchinterval(seconds)
    try:
        yield
    finally:
        sys.setswitchinterval(before)


def low_priority(niceness: int = _NICEST) -> None:
    """Leave the processor to others, also where the process was started with real-time priority."""
    os.setpriority(os.PRIO_PROCESS, 0, max(niceness, os.getpriority(os.PRIO_PROCESS, 0)))
    if hasattr(os, "sched_setscheduler"):
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))  # pushes nobody aside when it wakes


@contextmanager
def real_time(cpus: Sequence[int] | None = None, priority: int = 0) -> Iterator[list[str]]:
    """Run with real-time scheduling within a context.

    Parameters
    ----------
    cpus : sequence of int, optional
        Processors that this thread runs on. Default: all that the process may use.
    priority : int
        Priority of SCHED_FIFO, 1 to 99, of all threads of the process; 0 leaves the scheduler and memory
        locking unchanged. A thread without it that holds Python's interpreter lock may lose the processor to
        another program, and a thread that measures then waits for both.

    Yields
    ------
    list of str
        Settings that were not permitted, one line each.
    """
    refused: list[str] = []
    before = os.sched_getaffinity(0) if cpus else None
    usual, policies = (os.sched_getscheduler(0), os.sched_getparam(0)), {}
    for thread in _threads():
        with suppress(ProcessLookupError):  # it has ended
            policies[thread] = os.sched_getscheduler(thread), os.sched_getparam(thread)
    if cpus:
        try:
            os.sched_setaffinity(0, cpus)
        except OSError as error:
            refused.append(f"processors {', '.join(map(str, cpus))}: {error.strerror}")
    if priority:
        try:
            for thread in _threads():
                with suppress(ProcessLookupError):
                    os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(priority))
        except OSError as error:
            refused.append(f"real-time priority {priority}: {error.strerror}")
        if ctypes.CDLL(None, use_errno=True).mlockall(_LOCK_CURRENT_AND_FUTURE):
            refused.append(f"locked memory: {os.strerror(ctypes.get_errno())}")
    collecting = gc.isenabled()
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        with quick_switching(_SWITCH_S):
            yield refused
    finally:
        if collecting:
            gc.enable()
        gc.unfreeze()
        if priority:
            ctypes.CDLL(None).munlockall()
            for thread in _threads():
                with suppress(ProcessLookupError):
                    os.sched_setscheduler(thread, *policies.get(thread, usual))
        if before is not None:
            os.sched_setaffinity(0, before)


def _threads() -> list[int]:
    """Return the threads of this process; 0, the calling one, where the system does not list them."""
    try:
        return [int(name) for name in os.listdir("/proc/self/task")]
    except OSError:
        return [0]
