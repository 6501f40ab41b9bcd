"""Copies between streams and an engine: frames into a pixel ring; commands read, and published elsewhere.

While frames come, the bridge polls the stream's counter and notices a new frame within a microsecond. After
`SPIN_S` without a frame it sleeps. A producer that posts semaphores (ImageStreamIO) or notifies (pyshmem,
``notify=True``) wakes it; for other producers it polls every half millisecond. With fewer than
`SPINNING_NEEDS` processors it always sleeps, because polling would displace the engine or the camera.
"""

import contextlib
import math
import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from faintspot.base.checks import not_none, number_between
from faintspot.base.errors import InputError
from faintspot.engine.frames.pixel_ring import PixelRing
from faintspot.engine.frames.readout import ring_type
from faintspot.engine.streams.image_stream import ImageStreamWriter, Publication
from faintspot.engine.streams.stream import Follower, Stream, StreamCounters, image_name

SPIN_S = 0.02
"""Time after a frame during which the bridge polls for the next one without a pause [s]."""
SPINNING_NEEDS = 3
"""Processors that polling needs: for the engine, the bridge and the producer."""
STALL_S = 1.0
"""Silence after which a stream that has published frames counts as stalled [s]."""
_PARK_S = 0.05
_LOOK_S = 0.1  # between two attempts to open a missing stream


@dataclass(slots=True)
class BridgeCounters(StreamCounters):
    """Counters of a bridge, changed in place; `taken` counts the frames published in the ring."""

    not_ahead: int = 0
    """Frames whose number was not above that of the frame before: two writers, or a source that restarted."""
    stalls: int = 0
    """Number of times that no frame came for `STALL_S`."""


class StreamBridge(Follower):
    """Bridge that copies a stream's frames into a pixel ring, also after restarts of the producer.

    A frame's number is pyshmem's `frame_id` where the producer sets one, else the publication count minus
    one; both start at 0. uint16 frames stay uint16; all other real types become float32. If the stream comes
    back with frames of another size or type, the ring is closed and a new one of the same name is made.

    Parameters
    ----------
    stream : str
        Name of the stream, which need not exist yet: NAME (pyshmem) or isio:NAME.
    name : str
        Name of the pixel ring.
    say : function, optional
        Called with a one-line message when the stream appears, stalls or changes.
    spins : bool, optional
        Whether to poll for the next frame without a pause. Default: with enough processors.

    Raises
    ------
    InputError
        When no stream can have that name.
    MissingExtraError
        When the stream is pyshmem's and pyshmem is not installed.
    """

    counters: BridgeCounters
    holds = "pixels"

    def __init__(
        self, stream: str, name: str, *, say: Callable[[str], None] | None = None, spins: bool | None = None
    ) -> None:
        super().__init__(stream, say, _no_frames)
        self.name, self.counters = name, BridgeCounters()
        enough = len(os.sched_getaffinity(0)) >= SPINNING_NEEDS
        self._spin_s = SPIN_S if (enough if spins is None else spins) else 0.0
        self._ring: PixelRing | None = None
        self._last_number = -1
        self._arrived, self._silent = -math.inf, True

    def run(self, n_frames: int | None = None, stop: threading.Event | None = None) -> BridgeCounters:
        """Copy frames until `n_frames` have passed or `stop` is set.

        Raises
        ------
        InputError
            When another process writes into the ring, shared memory is short, or pyshmem's lock folder is not
            private.
        """
        limit = None if n_frames is None else int(number_between("n_frames", n_frames, 1, integer=True))
        counters = self.counters
        try:
            while not (stop is not None and stop.is_set()) and (limit is None or counters.taken < limit):
                self.step()
        finally:
            self.close()
        return counters

    def step(self) -> bool:
        """Follow the stream for at most 0.1 s; return whether a frame was copied.

        Raises
        ------
        InputError
            As `run`.
        """
        if self.source is not None and self._new_one():
            return self._pass_on()
        self._look_after()
        return False

    def close(self) -> None:
        """Close the stream and remove the ring."""
        super().close()
        if self._ring is not None:
            self._ring.close()
            self._ring = None

    # ---- one frame

    def _new_one(self) -> bool:
        """Wait for a publication; return False if none comes in time."""
        source, last_count = not_none(self.source), self.seen
        end = self._arrived + self._spin_s
        while source.count == last_count:
            if time.monotonic() > end:
                return source.wait(last_count, _PARK_S)
        return True

    def _pass_on(self) -> bool:
        """Copy the newest publication into the ring; return whether it was whole."""
        source, ring, counters = not_none(self.source), not_none(self._ring), self.counters
        expected = source.number
        slot = ring.begin(expected)
        with np.errstate(over="ignore"):  # values beyond float32 become infinite: bad pixels
            publication = self.take(_PARK_S, slot)
        if publication is None:
            self.seen = source.count
            return False
        number = publication.number
        if number != expected:  # a newer frame was published meanwhile
            ring.begin(number)[...] = slot.copy()
        ring.end()
        counters.taken += 1
        counters.not_ahead += number <= self._last_number
        if self._silent and self._last_number >= 0:
            self.say("resumed")
        self._last_number = number
        self._arrived, self._silent = time.monotonic(), False
        return True

    # ---- the stream

    def _look_after(self) -> None:
        """Look whether the stream is there and the same, and report when it has stalled."""
        if self.look() is not None:
            return
        if self.source is None:
            time.sleep(_LOOK_S)
        elif not self._silent and time.monotonic() - self._arrived > STALL_S:
            lives = {True: ", which made it, is alive", False: ", which made it, has ended", None: ""}
            maker = f"{self.source.maker}{lives[self.source.maker_lives()]}"
            self.say(f"no frame for {STALL_S:g} s; {maker}")
            self.counters.stalls += 1
            self._silent = True

    def prepare(self, source: Stream) -> None:
        """Make a ring of a stream's shape and type, unless there is one."""
        self._last_number, self._silent = -1, True
        ring, (rows, columns), dtype = self._ring, source.shape, ring_type(source.dtype)
        if ring is None:  # publications before the first contact are not missed
            self.seen = source.count
        elif (ring.shape, ring.dtype) == (source.shape, dtype):
            return
        else:
            ring.close()
        self._ring = PixelRing.create(self.name, (rows, columns), dtype)


def _no_frames(shape: tuple[int, ...], dtype: np.dtype[np.generic]) -> str:
    """Return the expected shape and type, or "" if these are frames."""
    return "" if len(shape) == 2 and dtype.kind in "iuf" else "frames (rows, columns) of real numbers"


LARGEST_NM = 1e6
"""Largest accepted command [nm]; the mirror keeps its commands if any is larger."""


@dataclass(slots=True)
class CommandCounters(StreamCounters):
    """Counters of received commands, changed in place; `taken` counts those that the mirror has taken."""

    refused: int = 0
    """Commands that were not finite or exceeded `LARGEST_NM`."""


class CommandStream(Follower):
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

    counters: CommandCounters
    holds = "commands"

    def __init__(self, stream: str, commands: int, say: Callable[[str], None]) -> None:
        super().__init__(stream, say, self._not_for_the_mirror)
        self.counters = CommandCounters()
        self.commands_nm: NDArray[np.float64] = np.zeros(commands)
        self.frame, self._refuses = -1, False

    def update(self) -> None:
        """Apply the newest commands."""
        publication = self.newest(_LOOK_S)
        if publication is not None:
            self._apply(publication)

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
            self.say(f"commands that are not finite or exceed {LARGEST_NM:g} nm; {self.meanwhile}")
        self._refuses = True

    @property
    def meanwhile(self) -> str:
        """See `Follower`."""
        taken = self.counters.taken
        return f"the mirror {'keeps its last commands' if taken else 'stays flat'}"

    def _not_for_the_mirror(self, shape: tuple[int, ...], dtype: np.dtype[np.generic]) -> str:
        """Return the expected shape and type, or "" if these are the mirror's commands."""
        expected = self.commands_nm.shape
        return "" if shape == expected and dtype.kind in "iuf" else f"{expected} real numbers, nm"


class StreamOut(Follower):
    """Republication of a stream of the engine for other programs.

    Parameters
    ----------
    stream : str
        Name of the stream, e.g. NAME_slopes or NAME_commands; it need not exist yet.
    target : str
        isio:NAME.
    say : function, optional
        Called with a one-line message when the stream changes.

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
        super().__init__(stream, say, _no_commands)
        self._target = name
        self._writer: ImageStreamWriter | None = None

    def run(self, stop: threading.Event) -> None:
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
        if not self.wait(_PARK_S):
            return False
        publication = self.take(_PARK_S)
        if publication is None:
            return False
        not_none(self._writer).publish(publication.values, publication.number)
        self.counters.taken += 1
        return True

    def close(self) -> None:
        """Close the engine's stream and remove the target."""
        super().close()
        if self._writer is not None:
            with contextlib.suppress(OSError):
                self._writer.close()
            self._writer = None

    def prepare(self, source: Stream) -> None:
        """Make the target, unless it exists with that number of values."""
        writer = self._writer
        if writer is not None and writer.shape[-1:] == source.shape:
            return
        if writer is not None:
            writer.close()
        self._writer = ImageStreamWriter(self._target, source.shape)
        self.say(f"passed on as isio:{self._writer.path}")


def _no_commands(shape: tuple[int, ...], dtype: np.dtype[np.generic]) -> str:
    """Return the expected shape and type, or "" if this is a vector from the engine."""
    return "" if len(shape) == 1 and dtype == np.float32 else "a vector of float32"
