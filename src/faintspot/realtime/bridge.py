"""Frames of a pyshmem stream into a pixel ring: for cameras, simulators and pyRTC, which publish them.

How it waits: while frames come it looks at the stream's count again and again, which notices one within a
microsecond. When nothing has come for `SPIN_S` it leaves the processor alone and waits as pyshmem does: a
producer of a stream made with ``notify=True`` wakes it (futex), for others it looks every half millisecond.
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

from faintspot.checks import number_between
from faintspot.realtime.camera import StopEvent
from faintspot.realtime.pixel_ring import PixelRing
from faintspot.realtime.replay import ring_type
from faintspot.realtime.shared_streams import lock_file, pyshmem_module

SPIN_S = 0.02
"""For so long after a frame the next one is waited for without a pause."""
SPINNING_NEEDS = 3
"""Processors: for the engine, the bridge, and the producer."""
STALL_S = 1.0
"""A stream that was silent for so long, after frames had come, has stalled."""
_PARK_S, _NAP_S = 0.05, 5e-4
_LOOK_S = 0.1  # between two looks for a stream that is not there
_LARGEST_NUMBER = 2**63 - 1


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
    """How often the stream was made anew."""


class StreamBridge:
    """Follows a stream by its name, through its producer's restarts; its frames go into a pixel ring.

    A frame's number is the publication's `frame_id` where the producer sets one, else its count less one, so
    that both begin with 0. uint16 frames stay so, all other real ones become float32. When the stream comes
    back with frames of another size or type, the ring is closed and another one of that name made.

    Parameters
    ----------
    stream : str
        Name of the stream; it need not exist yet.
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
    MissingExtraError
        Without pyshmem.
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
        self._pyshmem: Any = pyshmem_module("reading a stream in shared memory")
        self.stream, self.name, self._slots = stream, name, slots
        self._say = say or (lambda _: None)
        self.counters = BridgeCounters()
        enough = len(os.sched_getaffinity(0)) >= SPINNING_NEEDS
        self._spin_s = SPIN_S if (enough if spins is None else spins) else 0.0
        self._source: Any = None
        self._ring: PixelRing | None = None
        self._seen, self._last_number = 0, -1
        self._arrived, self._silent, self._told = -math.inf, True, ""

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
        if self._source is None:
            obstacle = self._open()
            if obstacle and obstacle != self._told:
                self._say(f"stream {self.stream}: {obstacle}; waiting")
            self._told = obstacle
            if obstacle:
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
        source, seen = self._source, self._seen
        end = self._arrived + self._spin_s
        while source.count == seen:
            if time.monotonic() > end:
                break
        else:
            return True
        try:
            source.wait_for_count(after=seen, timeout=_PARK_S, poll_interval=_NAP_S)
        except TimeoutError:
            return False
        except self._pyshmem.InconsistentStreamError:
            time.sleep(_PARK_S)  # a writer died in the middle: there may come another
            return bool(source.count != seen)
        return True

    def _pass_on(self) -> bool:
        """Copy the newest publication into the ring; return whether it was whole."""
        source, ring, counters = self._source, self._ring, self.counters
        assert ring is not None
        expected = _number(source.frame_id, source.count)
        slot = ring.begin(expected)
        try:
            with np.errstate(over="ignore"):  # what float32 cannot hold is infinite: a bad pixel
                publication = source.read_publication(out=slot, timeout=_PARK_S)
        except (TimeoutError, self._pyshmem.InconsistentStreamError):
            counters.incomplete += 1
            self._seen = source.count
            return False
        number = _number(publication.frame_id, publication.count)
        if number != expected:  # a newer one came meanwhile
            ring.begin(number)[...] = slot.copy()
        ring.end()
        counters.frames += 1
        counters.missed += publication.count - self._seen - 1
        counters.not_ahead += number <= self._last_number
        if self._silent and self._last_number >= 0:
            self._say(f"stream {self.stream}: goes on")
        self._seen, self._last_number = publication.count, number
        self._arrived, self._silent = time.monotonic(), False
        return True

    # ---- the stream

    def _open(self) -> str:
        """Open the stream and make the ring for it; return what stands in the way, "" for nothing."""
        lock_file(self.stream)  # refuses a place that is not private, in which pyshmem makes one
        try:
            # Not read-only: pyshmem leaves it to readers to mark what a writer that died has left half
            # written, and without that its successor's frames cannot be told from torn ones.
            source = self._pyshmem.open(self.stream, gpu_device=False)
        except FileNotFoundError:
            return "is not there"
        except (OSError, ValueError) as error:  # half made, or not for us
            return f"cannot be opened ({' '.join(str(error).split())})"
        shape, dtype = tuple(source.shape), source.dtype
        if len(shape) != 2 or dtype.kind not in "iuf":
            source.close()
            return f"holds {shape} {dtype}, expected frames (rows, columns) of real numbers"
        # What was published before a stream is first met is not missed; what a new producer had published is.
        self._seen = source.count if self._ring is None else 0
        self._source, self._last_number = source, -1
        self._make_ring((shape[0], shape[1]), ring_type(dtype))
        self._say(f"stream {self.stream}: {shape[0]} x {shape[1]} pixels ({dtype}), pid {source.creator_pid}")
        return ""

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
        try:
            there = self._pyshmem.stat(self.stream)["instance_id"]
        except (OSError, ValueError):
            there = None
        if there != self._source.instance_id:
            self._say(f"stream {self.stream}: {'was removed' if there is None else 'was made anew'}")
            self.counters.restarts += 1
            self._let_go()
        elif not self._silent and time.monotonic() - self._arrived > STALL_S:
            lives = "lives" if self._source.producer_alive() else "is gone"
            maker = f"pid {self._source.creator_pid}, which made it, {lives}"
            self._say(f"stream {self.stream}: no frame for {STALL_S:g} s; {maker}")
            self.counters.stalls += 1
            self._silent = True

    def _let_go(self) -> None:
        """Close the stream."""
        if self._source is not None:
            self._source.close()
        self._source, self._silent = None, True


def _number(frame_id: int, count: int) -> int:
    """Return a publication's frame number; of a writer that stamps nothing, frame_id is 0."""
    return (frame_id or max(count - 1, 0)) & _LARGEST_NUMBER
