"""A mirror's commands: read from a stream that may be missing, wrong or recreated, and published."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from faintspot.base.checks import not_none
from faintspot.base.errors import InputError
from faintspot.engine.pixels.readout import StopEvent
from faintspot.engine.streams.image_stream import ImageStreamWriter, Publication
from faintspot.engine.streams.stream import Follower, Stream, StreamCounters, image_name

LARGEST_NM = 1e6
"""Largest accepted command [nm]; the mirror keeps its commands if any is larger."""
_LOOK_S = 0.1  # between two checks whether the stream exists and is the same
_READ_S = 1e-3  # to wait for a writer in the middle of a publication


@dataclass(slots=True)
class CommandCounters(StreamCounters):
    """Counters of received commands, changed in place; `taken` counts those that the mirror has taken."""

    refused: int = 0
    """Commands that were not finite or exceeded `LARGEST_NM`."""


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
        self.stream, self.counters = stream, CommandCounters()
        self._follower = Follower(
            stream,
            say,
            self._incompatible,
            lambda: self._keeps,
            holds="commands",
            counters=self.counters,
        )
        self.commands_nm: NDArray[np.float64] = np.zeros(commands)
        self.frame, self._refuses = -1, False

    @property
    def state(self) -> str:
        """Reason why the stream cannot be read; "" if it can."""
        return self._follower.obstacle

    def take(self) -> None:
        """Apply the newest commands."""
        publication = self._follower.newest(_READ_S, _LOOK_S)
        if publication is not None:
            self._apply(publication)

    def close(self) -> None:
        """Close the stream."""
        self._follower.close()

    def _apply(self, publication: Publication) -> None:
        """Take commands, unless they are out of range."""
        values = publication.values.astype(np.float64)
        if np.all(np.abs(values) <= LARGEST_NM):
            self.counters.taken += 1
            self._refuses = False
            self.commands_nm, self.frame = values, publication.number
            return
        self.counters.refused += 1
        if not self._refuses:
            self._follower.say(f"commands that are not finite or exceed {LARGEST_NM:g} nm; {self._keeps}")
        self._refuses = True

    @property
    def _keeps(self) -> str:
        taken = self.counters.taken
        return f"the mirror {'keeps its last commands' if taken else 'stays flat'}"

    def _incompatible(self, shape: tuple[int, ...], dtype: np.dtype[np.generic]) -> str:
        """Return the expected shape and type, or "" if these are the mirror's commands."""
        expected = self.commands_nm.shape
        return "" if shape == expected and dtype.kind in "iuf" else f"{expected} real numbers, nm"


_PARK_S = 0.05


class StreamOut:
    """Republication of a stream of the engine for other programs.

    Parameters
    ----------
    stream : str
        Name of the stream, e.g. NAME_slopes or NAME_commands; it need not exist yet.
    target : str
        isio:NAME.
    say : function, optional
        Called with a one-line message when the stream changes.

    Attributes
    ----------
    counters : StreamCounters

    Raises
    ------
    InputError
        When the target is of another kind.
    MissingExtraError
        When pyshmem is not installed.
    """

    def __init__(self, stream: str, target: str, say: Callable[[str], None] | None = None) -> None:
        name = image_name(target)
        if name is None:
            raise InputError(f"{target}: expected isio:NAME (pyshmem programs can read {stream})")
        self._target = name
        self._follower = Follower(stream, say or (lambda _: None), _incompatible, prepare=self._prepare)
        self._writer: ImageStreamWriter | None = None
        self.counters = self._follower.counters

    def run(self, stop: StopEvent) -> None:
        """Pass publications on until `stop` is set.

        Raises
        ------
        InputError
            When the target cannot be made, or belongs to another living process.
        """
        try:
            while not stop.is_set():
                self.step()
        finally:
            self.close()

    def step(self) -> bool:
        """Follow the stream for a moment; return whether something was passed on."""
        follower = self._follower
        if not follower.wait(_PARK_S):
            return False
        publication = follower.take(_PARK_S)
        if publication is None:
            return False
        not_none(self._writer).publish(publication.values, publication.number)
        self.counters.taken += 1
        return True

    def close(self) -> None:
        """Close the engine's stream and remove the target."""
        self._follower.close()
        if self._writer is not None:
            with contextlib.suppress(OSError):
                self._writer.close()
            self._writer = None

    def _prepare(self, source: Stream) -> None:
        """Make the target, unless it exists with that number of values."""
        writer = self._writer
        if writer is not None and writer.shape[-1:] == source.shape:
            return
        if writer is not None:
            writer.close()
        self._writer = ImageStreamWriter(self._target, source.shape)
        self._follower.say(f"passed on as isio:{self._writer.path}")


def _incompatible(shape: tuple[int, ...], dtype: np.dtype[np.generic]) -> str:
    """Return the expected shape and type, or "" if this is a vector from the engine."""
    return "" if len(shape) == 1 and dtype == np.float32 else "a vector of float32"
