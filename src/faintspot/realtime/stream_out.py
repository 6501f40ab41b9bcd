"""The engine's slopes and commands as ImageStreamIO or dao streams, for milk, cacao and dao."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from faintspot.base.errors import InputError
from faintspot.io.frame_numbers import left_out
from faintspot.realtime.camera import StopEvent
from faintspot.realtime.image_stream import ImageStreamWriter
from faintspot.realtime.stream import Follower, split_name

_LOOK_S = 0.1  # between two attempts to open a missing stream
_PARK_S = 0.05


class StreamOut:
    """Republication of a stream of the engine for other programs.

    Parameters
    ----------
    stream : str
        Name of the stream, e.g. NAME_slopes or NAME_commands; it need not exist yet.
    target : str
        isio:NAME or dao:FILE.
    say : function, optional
        Called with a one-line message when the stream changes.

    Attributes
    ----------
    published, missed : int
        Publications that were passed on, and those overwritten before.

    Raises
    ------
    InputError
        When the target is of another kind.
    MissingExtraError
        When pyshmem is not installed.
    """

    def __init__(self, stream: str, target: str, say: Callable[[str], None] | None = None) -> None:
        self._kind, self._target = split_name(target)
        if not self._kind:
            raise InputError(f"{target}: expected isio:NAME or dao:FILE (pyshmem programs can read {stream})")
        self._follower = Follower(stream, say or (lambda _: None), _incompatible, lambda: "waiting")
        self._writer: ImageStreamWriter | None = None
        self._seen = self.published = self.missed = 0

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
        """Follow the stream for at most 0.1 s; return whether something was passed on."""
        source = self._follower.source
        if source is None:
            source = self._follower.open()
            if source is None:
                time.sleep(_LOOK_S)
                return False
            self._seen = 0
            self._prepare(source.shape)
        if not source.wait(self._seen, _PARK_S):
            happened = self._follower.lost()
            if happened:
                self._follower.say(happened)
            return False
        publication = source.read(None, _PARK_S)
        if publication is None:
            self._seen = source.count
            return False
        assert self._writer is not None
        self._writer.publish(publication.values, publication.number)
        self.missed += max(left_out(self._seen, publication.total), 0) if self._seen else 0
        self._seen = publication.total
        self.published += 1
        return True

    def close(self) -> None:
        """Close the engine's stream and remove the target."""
        self._follower.close()
        if self._writer is not None:
            with contextlib.suppress(OSError):
                self._writer.close()
            self._writer = None

    def _prepare(self, shape: tuple[int, ...]) -> None:
        """Make the target with that size, unless it exists."""
        writer = self._writer
        if writer is not None and writer.shape[-1:] == shape:
            return
        if writer is not None:
            writer.close()
        self._writer = ImageStreamWriter(self._kind, self._target, shape)
        self._follower.say(f"{shape[0]} values to {self._kind}:{self._writer.path}")


def _incompatible(shape: tuple[int, ...], dtype: np.dtype[Any]) -> str:
    """Return the expected shape and type, or "" if this is a vector from the engine."""
    return "" if len(shape) == 1 and dtype == np.float32 else "a vector of float32"
