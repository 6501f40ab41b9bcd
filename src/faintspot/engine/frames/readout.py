"""Read-out of frames row by row at a camera's pace, and recorded frames read ahead and published."""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from itertools import chain
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from faintspot.base.checks import number_between
from faintspot.base.errors import InputError
from faintspot.engine.frames.pixel_ring import PixelRing
from faintspot.slopes.simulate import Detector

if TYPE_CHECKING:
    from faintspot.io import FrameSource


_SPIN_NS = 150_000  # a sleep may overrun by this much; the last part is a busy wait
_BETWEEN_REPORTS_NS = 100_000_000
LATE = 0.1
"""Delay, as a fraction of the frame time, beyond which a frame counts as late."""


@dataclass(frozen=True)
class CameraReport:
    """Result of a camera run.

    Attributes
    ----------
    frames : int
        Frames published.
    overruns : int
        Frame times without a frame, because the frame before came too late.
    seconds : float
        Time from the start of the first frame to the end of the last frame time.
    late : int
        Frames that started more than `LATE` of the frame time after their scheduled time.
    """

    frames: int
    overruns: int
    seconds: float
    late: int = 0

    @property
    def frame_rate_hz(self) -> float:
        """Frames published per second."""
        return self.frames / self.seconds if self.seconds else 0.0


class Readout(ABC):
    """Source that publishes frames in a ring on a fixed schedule, row by row, at a camera's pace.

    Parameters
    ----------
    ring : PixelRing
        Ring created by this process.
    shape, dtype
        Shape and type of the frames.
    frame_rate_hz : float
        Frames per second, up to 100,000.
    readout_fraction : float
        Part of the frame time in which the rows arrive one after another, 0 to 1. 0: all at once.
    rows_per_block : int
        Rows that are published together.
    first_number : int
        Number of the first frame.
    spins : bool
        Whether to busy-wait for the last 0.15 ms before each scheduled time, because a sleep may overrun by
        that.

    Attributes
    ----------
    late, overruns : int
        Counts of the current run; as in `CameraReport`.

    Raises
    ------
    InputError
        When a value is out of its range, or the ring does not fit the frames.
    """

    def __init__(
        self,
        ring: PixelRing,
        shape: tuple[int, int],
        dtype: np.dtype[np.generic],
        *,
        frame_rate_hz: float,
        readout_fraction: float = 0.8,
        rows_per_block: int = 4,
        first_number: int = 0,
        spins: bool = True,
    ) -> None:
        if (ring.shape, ring.dtype) != (shape, dtype):
            raise InputError(
                f"ring: expected frames of {shape} and {dtype}, got {ring.shape} and {ring.dtype}"
            )
        rate = number_between("frame_rate_hz", frame_rate_hz, 0, 1e5, low_open=True)
        fraction = number_between("readout_fraction", readout_fraction, 0, 1)
        rows = ring.shape[0]
        block = int(number_between("rows_per_block", rows_per_block, 1, rows, integer=True))
        self._ring, self._period_ns, self._next = ring, 1e9 / rate, first_number
        self._spins, self.late, self.overruns = spins, 0, 0
        self._stop = threading.Event()
        ends = [*range(block, rows, block), rows]
        # First row, last row and time after the start of the frame, for each block.
        self._blocks = [
            (first, last, round(fraction * self._period_ns * last / rows))
            for first, last in zip([0, *ends[:-1]], ends, strict=True)
        ]

    @abstractmethod
    def _frame(self) -> NDArray[np.generic] | None:
        """Return frame number `_next`, or None at the end."""

    def run(
        self,
        n_frames: int | None = None,
        stop: threading.Event | None = None,
        progress: Callable[[int], None] | None = None,
    ) -> CameraReport:
        """Publish frames until `n_frames` are out, the source ends or `stop` is set; a later call continues.

        Frames start on a fixed schedule, which does not drift. A late frame is published as fast as possible;
        if no time is left for the next one, that frame time is skipped and counted as an overrun. Frame
        numbers then have no gaps. `progress` is called ten times a second with the number of frames.

        Raises
        ------
        InputError
            When `n_frames` is not a whole number of at least 1.
        """
        limit = None if n_frames is None else int(number_between("n_frames", n_frames, 1, integer=True))
        start, tick, published, reported_ns = time.monotonic_ns(), 0, 0, 0
        self._stop = threading.Event() if stop is None else stop
        self.late = self.overruns = 0
        while (limit is None or published < limit) and not self._stop.is_set():
            frame = self._frame()  # before its scheduled time, because it may have to be fetched
            if frame is None:
                break
            moment = start + round(tick * self._period_ns)
            _wait_until(moment, self._spins)
            now = time.monotonic_ns()
            self.late += now - moment > LATE * self._period_ns
            self._publish(moment, frame)
            published += 1
            tick = max(tick + 1, int((time.monotonic_ns() - start) // self._period_ns))
            self.overruns = tick - published
            if progress is not None and now - reported_ns > _BETWEEN_REPORTS_NS:
                progress(published)
                reported_ns = now
        if published:
            # The last frame takes its full frame time too, so that rates are right.
            _wait_until(start + round(tick * self._period_ns), self._spins)
        if progress is not None:
            progress(published)
        return CameraReport(published, self.overruns, (time.monotonic_ns() - start) / 1e9, self.late)

    def _publish(self, moment: int, frame: NDArray[np.generic]) -> None:
        """Read out one frame that starts at `moment`."""
        ring = self._ring
        slot = ring.begin(self._next)
        for first, last, delay in self._blocks:
            _wait_until(moment + delay, self._spins)
            slot[first:last] = frame[first:last]
            ring.rows_ready(last)
        self._next += 1

    def _await_engine(self, arrival: int) -> bool:
        """Wait until the engine has finished an arrival; return False if it will not."""
        while (followed := self._ring.followed) is not None and not self._stop.is_set():
            if followed[0] >= arrival:
                return True
            _nap()
        return False


def readout_type(detector: Detector) -> np.dtype[np.generic]:
    """Return the type of a detector's frames: float32, or uint16 or uint32 if it has `bits`."""
    if detector.bits is None:
        return np.dtype(np.float32)
    return np.dtype(np.uint16 if detector.bits <= 16 else np.uint32)


def _wait_until(moment: int, spins: bool) -> None:
    """Wait until a time of CLOCK_MONOTONIC, ns; return at once if it is past."""
    remaining, busy = moment - time.monotonic_ns(), _SPIN_NS if spins else 0
    if remaining > busy:
        time.sleep((remaining - busy) / 1e9)
    while spins and time.monotonic_ns() < moment:
        pass


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

    def run(
        self,
        n_frames: int | None = None,
        stop: threading.Event | None = None,
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
