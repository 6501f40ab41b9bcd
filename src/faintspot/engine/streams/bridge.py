"""Copy the frames of a stream into a pixel ring.

While frames come, the bridge polls the stream's counter and notices a new frame within a microsecond. After
`SPIN_S` without a frame it sleeps. A producer that posts semaphores (ImageStreamIO) or notifies (pyshmem,
``notify=True``) wakes it; for other producers it polls every half millisecond. With fewer than
`SPINNING_NEEDS` processors it always sleeps, because polling would displace the engine or the camera.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from faintspot.base.checks import not_none, number_between
from faintspot.engine.pixels.pixel_ring import PixelRing
from faintspot.engine.pixels.readout import StopEvent, ring_type
from faintspot.engine.streams.stream import Follower, Stream, StreamCounters

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


class StreamBridge:
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
    slots : int
        Frames in the ring.
    spins : bool, optional
        Whether to poll for the next frame without a pause. Default: with enough processors.

    Raises
    ------
    InputError
        When no stream can have that name.
    MissingExtraError
        When the stream is pyshmem's and pyshmem is not installed.
    """

    def __init__(
        self,
        stream: str,
        name: str,
        *,
        say: Callable[[str], None] | None = None,
        slots: int = 4,
        spins: bool | None = None,
    ) -> None:
        self.stream, self.name, self._slots = stream, name, slots
        self.counters = BridgeCounters()
        self._follower = Follower(
            stream,
            say or (lambda _: None),
            _incompatible,
            counters=self.counters,
            holds="pixels",
            prepare=self._prepare,
        )
        enough = len(os.sched_getaffinity(0)) >= SPINNING_NEEDS
        self._spin_s = SPIN_S if (enough if spins is None else spins) else 0.0
        self._ring: PixelRing | None = None
        self._last_number = -1
        self._arrived, self._silent = -math.inf, True

    def run(self, n_frames: int | None = None, stop: StopEvent | None = None) -> BridgeCounters:
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
        if self._follower.source is not None and self._new_one():
            return self._pass_on()
        self._look_after()
        return False

    def close(self) -> None:
        """Close the stream and remove the ring."""
        self._follower.close()
        if self._ring is not None:
            self._ring.close()
            self._ring = None

    # ---- one frame

    def _new_one(self) -> bool:
        """Wait for a publication; return False if none comes in time."""
        source, last_count = not_none(self._follower.source), self._follower.seen
        end = self._arrived + self._spin_s
        while source.count == last_count:
            if time.monotonic() > end:
                return source.wait(last_count, _PARK_S)
        return True

    def _pass_on(self) -> bool:
        """Copy the newest publication into the ring; return whether it was whole."""
        follower, counters = self._follower, self.counters
        source, ring = not_none(follower.source), not_none(self._ring)
        expected = source.number
        slot = ring.begin(expected)
        with np.errstate(over="ignore"):  # values beyond float32 become infinite: bad pixels
            publication = follower.take(_PARK_S, slot)
        if publication is None:
            follower.seen = source.count
            return False
        number = publication.number
        if number != expected:  # a newer frame was published meanwhile
            ring.begin(number)[...] = slot.copy()
        ring.end()
        counters.taken += 1
        counters.not_ahead += number <= self._last_number
        if self._silent and self._last_number >= 0:
            follower.say("resumed")
        self._last_number = number
        self._arrived, self._silent = time.monotonic(), False
        return True

    # ---- the stream

    def _look_after(self) -> None:
        """Look whether the stream is there and the same, and report when it has stalled."""
        follower = self._follower
        if follower.look() is not None:
            return
        if follower.source is None:
            time.sleep(_LOOK_S)
        elif not self._silent and time.monotonic() - self._arrived > STALL_S:
            lives = {True: ", which made it, is alive", False: ", which made it, has ended", None: ""}
            maker = f"{follower.source.maker}{lives[follower.source.maker_lives()]}"
            follower.say(f"no frame for {STALL_S:g} s; {maker}")
            self.counters.stalls += 1
            self._silent = True

    def _prepare(self, source: Stream) -> None:
        """Make a ring of a stream's shape and type, unless there is one."""
        self._last_number, self._silent = -1, True
        ring, (rows, columns), dtype = self._ring, source.shape, ring_type(source.dtype)
        if ring is None:  # publications before the first contact are not missed
            self._follower.seen = source.count
        elif (ring.shape, ring.dtype) == (source.shape, dtype):
            return
        else:
            ring.close()
        self._ring = PixelRing.create(self.name, (rows, columns), dtype, slots=self._slots)


def _incompatible(shape: tuple[int, ...], dtype: np.dtype[np.generic]) -> str:
    """Return the expected shape and type, or "" if these are frames."""
    return "" if len(shape) == 2 and dtype.kind in "iuf" else "frames (rows, columns) of real numbers"
