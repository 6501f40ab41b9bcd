"""Other faintspot commands as processes that end with this one, even if it is killed (Linux)."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from faintspot.base.closing import Closing
from faintspot.base.errors import InputError
from faintspot.base.files import output_errors

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
        self, name: str, arguments: Sequence[str], environment: Mapping[str, str] | None = None
    ) -> None:
        """Start `faintspot ARGUMENTS`; the calling thread must live as long as the process is needed.

        Parameters
        ----------
        name : str
        arguments : sequence of str
        environment : mapping, optional
            Variables to set for it.

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
                [sys.executable, "-m", "faintspot", *arguments],
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
