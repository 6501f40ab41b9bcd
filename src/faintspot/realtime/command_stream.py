"""A mirror's commands from a stream, which may be missing, wrong, or made anew."""

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
        self.stream = stream
        self._follower = Follower(stream, say, self._incompatible, lambda: self._keeps)
        self.commands_nm: NDArray[np.float64] = np.zeros(commands)
        self.frame, self.counters = -1, CommandCounters()
        self._seen, self._next_look_s = 0, 0.0
        self._refuses = False

    @property
    def state(self) -> str:
        """What is wrong with the stream, "" for nothing."""
        return self._follower.obstacle

    def take(self) -> None:
        """Let the mirror have the newest commands."""
        now = time.monotonic()
        if not self._read() and now >= self._next_look_s:
            self._next_look_s = now + _LOOK_S
            self._look_after()
            self._read()

    def close(self) -> None:
        """Let go of the stream."""
        self._follower.close()

    def _read(self) -> bool:
        """Take commands that are new; return whether whole ones had come."""
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
                self._follower.say(f"not finite, or beyond {LARGEST_NM:g} nm; {self._keeps}")
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
        """Nothing whole has come: see whether the stream is the same, look for one where there is none."""
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
        """Return what is expected where these are no commands of the mirror."""
        expected = self.commands_nm.shape
        return "" if shape == expected and dtype.kind in "iuf" else f"{expected} real numbers, nm"
