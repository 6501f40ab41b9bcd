"""Processes of lowest priority beside a running engine, which goes on whatever happens to them."""

from __future__ import annotations

import signal
import tempfile
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from faintspot.base.errors import InputError
from faintspot.engine.requests.child_processes import ChildProcesses
from faintspot.engine.requests.private_socket import socket_path
from faintspot.engine.requests.requests import LENGTHY_TIMEOUT_S, request
from faintspot.engine.requests.scheduling import lowest_priority
from faintspot.engine.telemetry.ring import TelemetryRing

ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
_WATCH_S = 1.0


class BackgroundProcess(ABC):
    """Reader of a running engine's telemetry that answers to it, in another process than the engine.

    Parameters
    ----------
    name : str
        Name of the engine.

    Raises
    ------
    InputError
        When there is no engine.
    """

    look_s: float
    """Time between two looks at the telemetry."""
    patience_s: float
    """Processor time after which an answer ends the process."""
    failed: str
    """Words for what an answer could not do."""

    def __init__(self, name: str) -> None:
        self._path, self._reader = socket_path(name), TelemetryRing.attach(name)

    def tell(self, command: str, models: Mapping[str, Any], **fields: object) -> dict[str, Any]:
        """Send the engine a command, with a file of each model that is not None; return its answer.

        Raises
        ------
        InputError
            When the engine refuses it, or does not answer.
        """
        with tempfile.TemporaryDirectory(prefix="faintspot-models-") as folder:
            files: dict[str, str | None] = {}
            for name, model in models.items():
                files[name] = None if model is None else f"{folder}/{name}.npz"
                if model is not None:
                    model.save(files[name])
            return request(self._path, command, timeout_s=LENGTHY_TIMEOUT_S, **files, **fields)

    def close(self) -> None:
        """Close the telemetry."""
        self._reader.close()

    @property
    def ended(self) -> bool:
        """Whether the engine has ended."""
        return self._reader.stale

    @abstractmethod
    def take(self) -> bool:
        """Take the telemetry that has come; return whether it is enough for an answer."""

    @abstractmethod
    def answer(self) -> str | None:
        """Answer to the engine; return a line about it, if there is something to say.

        Raises
        ------
        InputError
            When the telemetry tells nothing, or the engine refuses the answer.
        """

    def run(self, say: Callable[[str], None]) -> None:
        """Answer at the lowest priority until the engine ends; `say` takes a line for each answer."""
        lowest_priority()
        try:
            while not self.ended:
                time.sleep(self.look_s)
                if self.take():
                    self._answer_in_time(say)
        finally:
            self.close()

    def _answer_in_time(self, say: Callable[[str], None]) -> None:
        signal.setitimer(signal.ITIMER_PROF, self.patience_s)  # processor time: it may wait for long
        try:
            line = self.answer()
            if line is not None:
                say(line)
        except InputError as error:
            say(f"{self.failed}: {error}")
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0.0)


@contextmanager
def background_process(
    command: str, arguments: Sequence[str], on_fault: Callable[[str], None]
) -> Iterator[None]:
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
