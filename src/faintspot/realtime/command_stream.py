"""A mirror's commands from a pyshmem stream, which may be missing, wrong, or made anew."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.realtime.shared_streams import lock_file, pyshmem_module

LARGEST_NM = 1e6
"""Of a command: a mirror that is asked for more keeps what it has."""
_LOOK_S = 0.1  # between two looks for a stream that is not there, or whether it is still the same
_READ_S = 1e-3  # for a writer that is writing at this moment


@dataclass(slots=True)
class CommandCounters:
    """What has come; plain numbers, changed in place."""

    taken: int = 0
    """Commands that the mirror has taken."""
    overtaken: int = 0
    """Commands that a newer one replaced before the mirror looked."""
    refused: int = 0
    """Commands that were not finite, or beyond `LARGEST_NM`."""
    incomplete: int = 0
    """Commands whose writer died, or paused, in the middle."""
    restarts: int = 0
    """How often the stream was removed or made anew."""


class CommandStream:
    """What a mirror holds: the newest whole commands of a stream, zeros before the first.

    While the stream is missing, or holds something else, the mirror keeps what it has.

    Parameters
    ----------
    stream : str
        Name of the stream; it need not exist yet.
    commands : int
        Its length.
    say : function
        Told in one line what happens to the stream.

    Attributes
    ----------
    commands_nm : ndarray, float64, shape (commands,)
        What the mirror holds; a new array each time.
    frame : int
        Their publication's `frame_id`; -1 before the first.
    counters : CommandCounters

    Raises
    ------
    MissingExtraError
        Without pyshmem.
    """

    def __init__(self, stream: str, commands: int, say: Callable[[str], None]) -> None:
        self._pyshmem: Any = pyshmem_module("reading commands in shared memory")
        self.stream, self._say = stream, say
        self.commands_nm: NDArray[np.float64] = np.zeros(commands)
        self.frame, self.counters = -1, CommandCounters()
        self._source: Any = None
        self._seen, self._next_look_s = 0, 0.0
        self._told, self._refuses = "", False

    @property
    def state(self) -> str:
        """What is wrong with the stream, "" for nothing."""
        return self._told

    def take(self) -> None:
        """Let the mirror have the newest commands."""
        now = time.monotonic()
        if not self._read() and now >= self._next_look_s:
            self._next_look_s = now + _LOOK_S
            self._look_after()
            self._read()

    def close(self) -> None:
        """Let go of the stream."""
        if self._source is not None:
            self._source.close()
            self._source = None

    def _read(self) -> bool:
        """Take commands that are new; return whether whole ones had come."""
        counters = self.counters
        if self._source is None or self._source.count == self._seen:
            return False
        try:
            publication = self._source.read_publication(timeout=_READ_S)
        except (TimeoutError, self._pyshmem.InconsistentStreamError):
            counters.incomplete += 1
            return False
        counters.overtaken += max(0, publication.count - self._seen - 1)
        self._seen = publication.count
        values = publication.payload.astype(np.float64)
        if not np.all(np.abs(values) <= LARGEST_NM):
            counters.refused += 1
            if not self._refuses:
                self._say(f"stream {self.stream}: not finite, or beyond {LARGEST_NM:g} nm; {self._keeps}")
            self._refuses = True
            return True
        counters.taken += 1
        self._refuses = False
        self.commands_nm, self.frame = values, publication.frame_id
        return True

    @property
    def _keeps(self) -> str:
        taken = self.counters.taken
        return f"the mirror {'keeps its last commands' if taken else 'stays flat'}"

    def _look_after(self) -> None:
        """Nothing whole has come: see whether the stream is the same, look for one where there is none."""
        if self._source is not None:
            try:
                there = self._pyshmem.stat(self.stream)["instance_id"]
            except (OSError, ValueError):
                there = None
            if there == self._source.instance_id:
                return
            self.counters.restarts += 1
            self.close()
        obstacle = self._open()
        if obstacle and obstacle != self._told:
            self._say(f"stream {self.stream}: {obstacle}; {self._keeps}")
        self._told = obstacle

    def _open(self) -> str:
        """Open the stream; return what stands in the way, "" for nothing."""
        lock_file(self.stream)  # refuses a place that is not private, in which pyshmem makes one
        try:
            # Not read-only: readers mark what a writer that died has left half written.
            source = self._pyshmem.open(self.stream, gpu_device=False)
        except FileNotFoundError:
            return "is not there"
        except (OSError, ValueError) as error:  # half made, or not for us
            return f"cannot be opened ({' '.join(str(error).split())})"
        shape, dtype = tuple(source.shape), source.dtype
        expected = self.commands_nm.shape
        if shape != expected or dtype.kind not in "iuf":
            source.close()
            return f"holds {shape} {dtype}, expected {expected} real numbers, nm"
        self._source, self._seen = source, 0
        self._say(f"stream {self.stream}: {shape[0]} commands ({dtype}), pid {source.creator_pid}")
        return ""
