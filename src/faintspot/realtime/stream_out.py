"""What the engine publishes, as streams of ImageStreamIO or dao: for milk, cacao and dao's controllers."""

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

_LOOK_S = 0.1  # between two looks for a stream that is not there
_PARK_S = 0.05


class StreamOut:
    """Follows a stream of the engine's, and publishes the same for other programs.

    Parameters
    ----------
    stream : str
        As NAME_slopes or NAME_commands; it need not exist yet.
    target : str
        isio:NAME or dao:FILE.
    say : function, optional
        Told in one line what happens to the stream.

    Attributes
    ----------
    published, missed : int
        What was passed on, and what was overwritten before.

    Raises
    ------
    InputError
        For a target of another kind.
    MissingExtraError
        Without pyshmem.
    """

    def __init__(self, stream: str, target: str, say: Callable[[str], None] | None = None) -> None:
        self._kind, self._target = split_name(target)
        if not self._kind:
            raise InputError(f"{target}: expected isio:NAME or dao:FILE; pyshmem's stream is {stream}")
        self._follower = Follower(stream, say or (lambda _: None), _incompatible, lambda: "waiting")
        self._writer: ImageStreamWriter | None = None
        self._seen = self.published = self.missed = 0

    def run(self, stop: StopEvent) -> None:
        """Pass on what comes until `stop` is set.

        Raises
        ------
        InputError
            When the target cannot be made, or is another living process's.
        """
        try:
            while not stop.is_set():
                self.step()
        finally:
            self.close()

    def step(self) -> bool:
        """Follow the stream for a moment, 0.1 s at most; return whether something was passed on."""
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
        """Let go of the stream and remove ours."""
        self._follower.close()
        if self._writer is not None:
            with contextlib.suppress(OSError):
                self._writer.close()
            self._writer = None

    def _prepare(self, shape: tuple[int, ...]) -> None:
        """Have a stream of that size."""
        writer = self._writer
        if writer is not None and writer.shape[-1:] == shape:
            return
        if writer is not None:
            writer.close()
        self._writer = ImageStreamWriter(self._kind, self._target, shape)
        self._follower.say(f"{shape[0]} values to {self._kind}:{self._writer.path}")


def _incompatible(shape: tuple[int, ...], dtype: np.dtype[Any]) -> str:
    """Return what is expected where this is not a vector of the engine's."""
    return "" if len(shape) == 1 and dtype == np.float32 else "a vector of float32"
