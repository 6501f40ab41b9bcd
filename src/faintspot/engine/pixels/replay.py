"""Recorded frames as a source: read ahead from files and published in a pixel ring at a camera's pace."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from itertools import chain
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from faintspot.base.checks import number_between
from faintspot.base.errors import InputError
from faintspot.engine.pixels.pixel_ring import PixelRing
from faintspot.engine.pixels.readout import CameraReport, Readout, StopEvent
from faintspot.io import FrameSource

_BLOCK_BYTES, _BLOCKS_AHEAD = 4 << 20, 8
_LOOK_S = 0.05  # between two checks of the stop event while waiting for the disk or the engine
_NAP_S = 5e-4  # between two checks of the engine's progress


def ring_type(dtype: np.dtype[np.generic]) -> np.dtype[np.generic]:
    """Return the type in which frames are sent to the engine: uint16 stays, other types become float32.

    Raises
    ------
    InputError
        When the type is not a real number.
    """
    if dtype.kind not in "iuf":
        raise InputError(f"frames: expected real numbers, got dtype {dtype}")
    return np.dtype(np.uint16 if dtype == np.uint16 else np.float32)


class Replay(Readout):
    """Source that publishes recorded frames; a context manager that reads ahead meanwhile.

    The first frame's number is its index in the sequence, and numbers have no gaps: with `repeat`, number n
    is frame first + (n - first) % n_frames. A thread reads at most eight blocks of 4 MiB ahead, so that files
    of any size can be replayed.

    Parameters
    ----------
    source : FrameSource
        Frames from `faintspot.io.open_frames`.
    ring : PixelRing
        Ring created by this process, with the frames' shape and `ring_type`.
    frame_rate_hz : float
    first : int
        Index of the first frame, from 0.
    n_frames : int, optional
        Number of frames from there on. Default: all.
    repeat : bool
        Whether to start again at the end, without limit.
    rows_per_block : int, optional
        Rows that are published together, with a read-out that takes 80 % of the frame time. Default: whole
        frames.
    waits : bool
        Whether to wait for an engine and never overwrite a frame before it is measured; ends with the engine.
        Default: keep the schedule, whether or not the engine keeps up.

    Attributes
    ----------
    n_frames : int or None
        Number of frames to publish; None with `repeat`.
    lost : int
        Frames that the engine could not measure in time; set when `run` has ended.

    Raises
    ------
    InputError
        When a value is out of its range, or the ring does not fit; during the run, when a file is damaged.
    """

    def __init__(
        self,
        source: FrameSource,
        ring: PixelRing,
        *,
        frame_rate_hz: float,
        first: int = 0,
        n_frames: int | None = None,
        repeat: bool = False,
        rows_per_block: int | None = None,
        waits: bool = False,
    ) -> None:
        begin = int(number_between("first", first, 0, source.n_frames - 1, integer=True))
        most = source.n_frames - begin
        count = most if n_frames is None else int(number_between("n_frames", n_frames, 1, most, integer=True))
        super().__init__(
            ring,
            source.shape,
            ring_type(source.dtype),
            frame_rate_hz=frame_rate_hz,
            readout_fraction=0.0 if rows_per_block is None else 0.8,
            rows_per_block=ring.shape[0] if rows_per_block is None else rows_per_block,
            first_number=begin,
        )
        self.n_frames = None if repeat else count
        self._waits, self.lost = waits, 0
        self._source, self._range = source, (begin, begin + count)
        self._block: Iterator[NDArray[np.generic]] = iter(())
        self._chunks = self._converted()
        self._reader = ThreadPoolExecutor(1, "faintspot-reader")
        self._ahead: deque[Future[NDArray[np.generic] | None]] = deque()
        self._stop: StopEvent = threading.Event()

    def run(
        self,
        n_frames: int | None = None,
        stop: StopEvent | None = None,
        progress: Callable[[int], None] | None = None,
    ) -> CameraReport:
        """Publish frames as `Readout.run` does; the schedule starts when the first frame has been read.

        With `waits` it starts no earlier than the engine. It ends when the engine, if any, has measured the
        last frame.
        """
        self._stop, ring = threading.Event() if stop is None else stop, self._ring
        while self._waits and ring.followed is None and not self._stop.is_set():
            _nap()
        frame = self._frame()
        if frame is not None:
            self._block = chain([frame], self._block)
        report = super().run(n_frames, stop, progress)
        self._await_engine(ring.arrivals)
        followed = ring.followed
        self.lost = 0 if followed is None else followed[1]
        return report

    def __enter__(self) -> Self:
        for _ in range(_BLOCKS_AHEAD):
            self._ahead.append(self._reader.submit(self._read))
        return self

    def __exit__(self, *_: object) -> None:
        self._reader.shutdown(cancel_futures=True)

    def _frame(self) -> NDArray[Any] | None:
        """Return the next frame, or None at the end."""
        if self._waits and not self._await_engine(self._ring.arrivals + 1 - self._ring.slots):
            return None
        while (frame := next(self._block, None)) is None:
            while not self._ahead[0].done() and not self._stop.is_set():
                wait([self._ahead[0]], _LOOK_S)
            # The end, and the error of a damaged file, stay for later calls.
            block = self._ahead[0].result() if self._ahead[0].done() else None
            if block is None:
                return None
            self._ahead.popleft()
            self._ahead.append(self._reader.submit(self._read))
            self._block = iter(block)
        return frame

    def _read(self) -> NDArray[np.generic] | None:
        """Read the next block; return None at the end."""
        return next(self._chunks, None)

    def _await_engine(self, arrival: int) -> bool:
        """Wait until the engine has finished an arrival; return False if it will not."""
        while (followed := self._ring.followed) is not None and not self._stop.is_set():
            if followed[0] >= arrival:
                return True
            _nap()
        return False

    def _converted(self) -> Iterator[NDArray[np.generic]]:
        """Yield blocks of the frames in the ring's type, for the reader's thread."""
        source, dtype = self._source, self._ring.dtype
        size = max(1, _BLOCK_BYTES // (source.shape[0] * source.shape[1] * source.dtype.itemsize))
        while True:
            for _, block in source.blocks(*self._range, size):
                with np.errstate(over="ignore"):  # values beyond float32 become infinite: bad pixels
                    converted: NDArray[np.generic] = block.astype(dtype, copy=False)
                yield converted
            if self.n_frames is not None:
                return


def _nap() -> None:
    """Sleep briefly, to give the engine time."""
    time.sleep(_NAP_S)
