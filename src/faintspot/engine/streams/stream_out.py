"""The engine's slopes and commands as ImageStreamIO streams, for milk and cacao."""

from __future__ import annotations

import contextlib
from collections.abc import Callable

import numpy as np

from faintspot.base.checks import not_none
from faintspot.base.errors import InputError
from faintspot.engine.pixels.readout import StopEvent
from faintspot.engine.streams.image_stream import ImageStreamWriter
from faintspot.engine.streams.stream import Follower, Stream, image_name

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
