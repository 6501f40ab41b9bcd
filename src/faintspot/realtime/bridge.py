"""Frames of a stream into a pixel ring: for cameras, simulators and controllers, which publish them.

How it waits: while frames come it looks at the stream's count again and again, which notices one within a
microsecond. When nothing has come for `SPIN_S` it leaves the processor alone and waits: a producer that posts
semaphores (ImageStreamIO) or notifies (pyshmem, ``notify=True``) wakes it, for others it looks every half
millisecond.
With fewer than `SPINNING_NEEDS` processors it always does: it would displace the engine or the camera.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from faintspot.base.checks import number_between
from faintspot.io.frame_numbers import left_out
from faintspot.realtime.camera import StopEvent
from faintspot.realtime.pixel_ring import PixelRing
from faintspot.realtime.replay import ring_type
from faintspot.realtime.stream import Follower

SPIN_S = 0.02
"""For so long after a frame the next one is waited for without a pause."""
SPINNING_NEEDS = 3
"""Processors: for the engine, the bridge, and the producer."""
STALL_S = 1.0
"""A stream that was silent for so long, after frames had come, has stalled."""
_PARK_S = 0.05
_LOOK_S = 0.1  # between two looks for a stream that is not there


@dataclass(slots=True)
class BridgeCounters:
    """What a bridge has seen and done; plain numbers, changed in place."""

    frames: int = 0
    """Frames published in the ring."""
    missed: int = 0
    """Publications that were overwritten before they were read."""
    not_ahead: int = 0
    """Frames whose number was not above that of the frame before: two writers, or a source that restarted."""
    incomplete: int = 0
    """Publications whose writer died, or paused, in the middle."""
    stalls: int = 0
    """How often nothing came for `STALL_S`."""
    restarts: int = 0
    """How often the stream was made anew, or its count of publications jumped."""


class StreamBridge:
    """Follows a stream by its name, through its producer's restarts; its frames go into a pixel ring.

    A frame's number is pyshmem's `frame_id` where the producer sets one, else the stream's count less one, so
    that both begin with 0. uint16 frames stay so, all other real ones become float32. When the stream comes
    back with frames of another size or type, the ring is closed and another one of that name made.

    Parameters
    ----------
    stream : str
        Name of the stream, which need not exist yet: pyshmem's, isio:NAME or dao:FILE.
    name : str
        Of the pixel ring.
    say : function, optional
        Told in one line what happens to the stream.
    slots : int
        Frames in the ring.
    spins : bool, optional
        Whether to wait for the next frame without a pause. Default: with enough processors.

    Raises
    ------
    InputError
        For a name that no stream can have.
    MissingExtraError
        For one of pyshmem's without pyshmem.
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
        self._follower = Follower(stream, say or (lambda _: None), _incompatible, lambda: "waiting")
        self.counters = BridgeCounters()
        enough = len(os.sched_getaffinity(0)) >= SPINNING_NEEDS
        self._spin_s = SPIN_S if (enough if spins is None else spins) else 0.0
        self._ring: PixelRing | None = None
        self._seen, self._last_number = 0, -1
        self._arrived, self._silent = -math.inf, True

    def run(self, n_frames: int | None = None, stop: StopEvent | None = None) -> BridgeCounters:
        """Follow the stream until so many frames have passed or `stop` is set.

        Raises
        ------
        InputError
            When somebody else writes into the ring, shared memory is short, or the folder of pyshmem's locks
            is not private.
        """
        limit = None if n_frames is None else int(number_between("n_frames", n_frames, 1, integer=True))
        counters = self.counters
        try:
            while not (stop is not None and stop.is_set()) and (limit is None or counters.frames < limit):
                self.step()
        finally:
            self.close()
        return counters

    def step(self) -> bool:
        """Follow the stream for a moment, 0.1 s at most; return whether a frame has come through.

        Raises
        ------
        InputError
            As `run`.
        """
        if self._follower.source is None:
            if not self._open():
                time.sleep(_LOOK_S)
        elif self._new_one():
            return self._pass_on()
        else:
            self._look_after()
        return False

    def close(self) -> None:
        """Let go of the stream and remove the ring."""
        self._let_go()
        if self._ring is not None:
            self._ring.close()
            self._ring = None

    # ---- one frame

    def _new_one(self) -> bool:
        """Wait for a publication; False when there is none for a while."""
        source, seen = self._follower.source, self._seen
        assert source is not None
        end = self._arrived + self._spin_s
        while source.count == seen:
            if time.monotonic() > end:
                return source.wait(seen, _PARK_S)
        return True

    def _pass_on(self) -> bool:
        """Copy the newest publication into the ring; return whether it was whole."""
        source, ring, counters = self._follower.source, self._ring, self.counters
        assert source is not None
        assert ring is not None
        expected = source.number
        slot = ring.begin(expected)
        with np.errstate(over="ignore"):  # what float32 cannot hold is infinite: a bad pixel
            publication = source.read(slot, _PARK_S)
        if publication is None:
            counters.incomplete += 1
            self._seen = source.count
            return False
        number = publication.number
        if number != expected:  # a newer one came meanwhile
            ring.begin(number)[...] = slot.copy()
        ring.end()
        counters.frames += 1
        missed = left_out(self._seen, publication.total)
        counters.missed += max(missed, 0)
        counters.restarts += missed < 0 and publication.total > self._seen
        counters.not_ahead += number <= self._last_number
        if self._silent and self._last_number >= 0:
            self._follower.say("goes on")
        self._seen, self._last_number = publication.total, number
        self._arrived, self._silent = time.monotonic(), False
        return True

    # ---- the stream

    def _open(self) -> bool:
        """Open the stream and make the ring for it; return whether nothing stands in the way."""
        source = self._follower.open()
        if source is None:
            return False
        # What was published before a stream is first met is not missed; what a new producer had published is.
        self._seen = source.count if self._ring is None else 0
        self._last_number = -1
        rows, columns = source.shape
        self._make_ring((rows, columns), ring_type(source.dtype))
        self._follower.say(f"{rows} x {columns} pixels ({source.dtype}), {source.maker}")
        return True

    def _make_ring(self, shape: tuple[int, int], dtype: np.dtype[Any]) -> None:
        """Have a ring of that shape and type."""
        ring = self._ring
        if ring is not None and (ring.shape, ring.dtype) == (shape, dtype):
            return
        if ring is not None:
            ring.close()
        self._ring = PixelRing.create(self.name, shape, dtype, slots=self._slots)

    def _look_after(self) -> None:
        """Nothing came: see whether the stream is still there, and say so when it has stalled."""
        follower, source = self._follower, self._follower.source
        assert source is not None
        happened = follower.lost()
        if happened:
            follower.say(happened)
            self.counters.restarts += 1
            self._silent = True
        elif not self._silent and time.monotonic() - self._arrived > STALL_S:
            lives = {True: ", which made it, lives", False: ", which made it, is gone", None: ""}
            follower.say(f"no frame for {STALL_S:g} s; {source.maker}{lives[source.maker_lives()]}")
            self.counters.stalls += 1
            self._silent = True

    def _let_go(self) -> None:
        """Close the stream."""
        self._follower.close()
        self._silent = True


def _incompatible(shape: tuple[int, ...], dtype: np.dtype[Any]) -> str:
    """Return what is expected where these are no frames."""
    return "" if len(shape) == 2 and dtype.kind in "iuf" else "frames (rows, columns) of real numbers"
