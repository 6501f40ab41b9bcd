"""Poke a mirror through its command stream while an engine measures."""

import time

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.checks import number_between
from faintspot.base.errors import InputError
from faintspot.base.files import Closing
from faintspot.engine.streams.shared_streams import create_stream
from faintspot.engine.telemetry.ring import TelemetryRing

_POLL_S = 5e-4
_NO_FRAMES_S = 5.0
_NOTICED_S = 0.5  # time for the mirror's driver to find a new stream


class StreamedMirror(Closing):
    """A mirror that reads NAME_commands, and an engine NAME without control that measures its effect.

    As a context manager it flattens the mirror at the end and removes the stream. It is a `PokedMirror`.

    Parameters
    ----------
    name : str
        Name of the engine.
    commands : int
        Number of the mirror's commands.
    settle_frames : int
        Frames to skip after a command is sent, until it takes effect.
    frames : int
        Frames to average then.

    Raises
    ------
    InputError
        When no such engine runs, it makes commands itself, or another process sends commands.
    """

    def __init__(self, name: str, commands: int, *, settle_frames: int = 3, frames: int = 2) -> None:
        self.commands = int(number_between("commands", commands, 1, 100_000, integer=True))
        self._settle = int(number_between("settle_frames", settle_frames, 1, 10_000, integer=True))
        self._frames = int(number_between("frames", frames, 2, 100_000, integer=True))
        self._name, self._reader = name, TelemetryRing.attach(name)
        if self._reader.stale:
            raise InputError(f"the engine {name} has ended; start one with faintspot realtime run")
        if self._reader.description.get("commands"):
            raise InputError(
                f"the engine {name} makes commands itself; start it with faintspot realtime run --no-control"
            )
        reference = self._reader.description.get("reference")
        self.reference: Floats = np.zeros(2 * len(self._reader.layout)) if reference is None else reference
        """Reference slopes that the engine subtracts, (2 n,), px."""
        self._stream = create_stream(f"{name}_commands", (self.commands,))
        self._send(np.zeros(self.commands))
        time.sleep(_NOTICED_S)

    def close(self) -> None:
        """Flatten the mirror, and remove the stream after the mirror has had time to read it."""
        self._send(np.zeros(self.commands))
        newest = self._reader.records.written
        end = time.monotonic() + 1.0
        while self._reader.records.written < newest + 2 and time.monotonic() < end:
            time.sleep(_POLL_S)
        self._stream.unlink()
        self._reader.close()

    def slopes(self, command: Floats) -> tuple[Floats, NDArray[np.uint8]]:
        """Measure the slopes of a command; see `PokedMirror`.

        Raises
        ------
        InputError
            When no frames come, or the engine ends.
        """
        self._send(command)
        cursor = self._reader.records.written
        after = None
        blocks: list[NDArray[np.void]] = []
        count, end = 0, time.monotonic() + _NO_FRAMES_S
        while count < self._frames:
            records, cursor, _ = self._reader.records.since(cursor)
            if not len(records):
                self._wait(end)
                continue
            end = time.monotonic() + _NO_FRAMES_S
            after = int(records["sequence"][0]) + self._settle if after is None else after
            settled = records[records["sequence"] >= after][: self._frames - count]
            blocks.append(settled)
            count += len(settled)
        records_ = np.concatenate(blocks)
        return np.concatenate([records_["x"], records_["y"]], axis=1).astype(np.float64), records_["flags"]

    def _send(self, command: Floats) -> None:
        self._stream.write(command.astype(np.float32), frame_id=max(self._reader.records.written - 1, 0))

    def _wait(self, end: float) -> None:
        if self._reader.stale:
            raise InputError(f"the engine {self._name} has ended")
        if time.monotonic() > end:
            raise InputError(f"the engine {self._name} has measured no frame for {_NO_FRAMES_S:g} s")
        time.sleep(_POLL_S)
