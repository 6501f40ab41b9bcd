"""A mirror's commands read from a stream that may be missing, wrong or recreated."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.io.frame_numbers import left_out
from faintspot.realtime.stream import Follower

LARGEST_NM = 1e6
"""Largest accepted command [nm]; the mirror keeps its commands if any is larger."""
_LOOK_S = 0.1  # between two checks whether the stream exists and is the same
_READ_S = 1e-3  # to wait for a writer in the middle of a publication


@dataclass(slots=True)
class CommandCounters:
    """Counters of received commands, changed in place."""

    taken: int = 0
    """Commands that the mirror has taken."""
    overtaken: int = 0
    """Commands replaced by newer ones before the mirror read them."""
    refused: int = 0
    """Commands that were not finite or exceeded `LARGEST_NM`."""
    incomplete: int = 0
    """Commands whose writer died or paused before they were complete."""
    restarts: int = 0
    """Number of times that the stream was removed or recreated."""


class CommandStream:
    """Commands of a mirror: the newest complete ones of a stream, zeros before the first.

    While the stream is missing or unusable, the mirror keeps its commands.

    Parameters
    ----------
    stream : str
        Name of the stream; it need not exist yet.
    commands : int
        Number of commands.
    say : function
        Called with a one-line message when the stream changes.

    Attributes
    ----------
    commands_nm : ndarray, float64, shape (commands,)
        Commands of the mirror; a new array each time.
    frame : int
        `frame_id` of their publication; -1 before the first.
    counters : CommandCounters

    Raises
    ------
    MissingExtraError
        When pyshmem is not installed.
    """

    def __init__(self, stream: str, commands: int, say: Callable[[str], None]) -> None:
        self.stream = stream
        self._follower = Follower(stream, say, self._incompatible, lambda: self._keeps)
        self.commands_nm: NDArray[np.float64] = np.zeros(commands)
        self.frame, self.counters = -1, CommandCounters()
        self._seen, self._next_look_s = 0, 0.0
        self._refuses = False

    @property
    def state(self) -> str:
        """Reason why the stream cannot be read; "" if it can."""
        return self._follower.obstacle

    def take(self) -> None:
        """Apply the newest commands."""
        now = time.monotonic()
        if not self._read() and now >= self._next_look_s:
            self._next_look_s = now + _LOOK_S
            self._look_after()
            self._read()

    def close(self) -> None:
        """Close the stream."""
        self._follower.close()

    def _read(self) -> bool:
        """Read new commands; return whether complete ones had come."""
        counters, source = self.counters, self._follower.source
        if source is None or source.count == self._seen:
            return False
        publication = source.read(None, _READ_S)
        if publication is None:
            counters.incomplete += 1
            return False
        counters.overtaken += max(left_out(self._seen, publication.total), 0)
        self._seen = publication.total
        values = publication.values.astype(np.float64)
        if not np.all(np.abs(values) <= LARGEST_NM):
            counters.refused += 1
            if not self._refuses:
                self._follower.say(f"commands that are not finite or exceed {LARGEST_NM:g} nm; {self._keeps}")
            self._refuses = True
            return True
        counters.taken += 1
        self._refuses = False
        self.commands_nm, self.frame = values, publication.number
        return True

    @property
    def _keeps(self) -> str:
        taken = self.counters.taken
        return f"the mirror {'keeps its last commands' if taken else 'stays flat'}"

    def _look_after(self) -> None:
        """Check whether the stream is still the same, and try to open a missing one."""
        follower = self._follower
        if follower.source is not None:
            if not follower.lost():
                return
            self.counters.restarts += 1
        source = follower.open()
        if source is not None:
            self._seen = 0
            follower.say(f"{source.shape[0]} commands ({source.dtype}), {source.maker}")

    def _incompatible(self, shape: tuple[int, ...], dtype: np.dtype[Any]) -> str:
        """Return the expected shape and type, or "" if these are the mirror's commands."""
        expected = self.commands_nm.shape
        return "" if shape == expected and dtype.kind in "iuf" else f"{expected} real numbers, nm"
