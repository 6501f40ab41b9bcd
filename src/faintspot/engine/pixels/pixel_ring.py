"""Transfer of pixels from a camera to the engine, row by row, through a ring of frames in shared memory.

One process writes; any number of processes of the same user read. A camera never waits for a reader. After
using pixels, a reader checks with `PixelRing.intact` whether they were overwritten meanwhile. One reader, the
engine, publishes its position (`PixelRing.follow`), so that a writer that can wait loses no frame.

Memory layout, in bytes from the start of the segment::

    0      header, written once, with a checksum: magic, version, creator, generation, shape, type, slots
        128    written by the engine: number of arrivals done, frames lost, its process id and start time
        256    progress cells, 128 bytes apart to avoid sharing a cache line or a prefetched pair of lines:
               arriving frame, its complete rows, closed, arrivals (frames begun so far),
               then one cell per slot: frame number (-1 while it is replaced), arrival, time of its last row
    then   the slots, each of (rows, columns) pixels; frame n lies in slot n % slots

Nothing is locked. The writer stores pixels first and progress afterwards, each cell as one aligned 8-byte
store. The reader loads progress first, and checks the slot's cell again after using the pixels.
`faintspot.slopes.kernels.compilation.ordered` enforces this order on processors with weaker memory ordering.
"""

from __future__ import annotations

import mmap
import os
import time
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from faintspot.base.errors import InputError
from faintspot.engine.pixels.pixel_segment import (
    ARRIVALS,
    CELL_BYTES,
    CLOSED,
    FIRST_SLOT,
    FOLDER,
    FOLLOWED,
    FOLLOWER,
    FOLLOWER_START,
    FRAME,
    LOST,
    ROWS,
    SLOT_ARRIVAL,
    SLOT_FRAME,
    SLOT_TIME,
    Header,
    cells_of,
    create_segment,
    follower_of,
    identity_of,
    new_header,
    open_segment,
    segment_path,
)
from faintspot.engine.pixels.processes import process_lives, process_start
from faintspot.slopes.kernels.compilation.ordered import fence, load, store

__all__ = [
    "ARRIVALS",
    "CLOSED",
    "FIRST_SLOT",
    "FRAME",
    "ROWS",
    "SLOT_ARRIVAL",
    "SLOT_FRAME",
    "SLOT_TIME",
    "PixelRing",
]

_LINE = CELL_BYTES // 8


class PixelRing:
    """A ring of frames in shared memory, made by `create` (the writer) or `attach` (a reader).

    Readable and writable by the same user only. As a context manager it closes itself.

    Attributes
    ----------
    name : str
    shape : (int, int)
        Rows and columns of a frame.
    dtype : numpy.dtype
    slots : int
        Frames in the ring.
    generation : int
        Number that differs each time the ring is created.
    creator_pid : int
        Process that created it.
    cells : ndarray, int64, shape (4 + slots, 16)
        Progress cells for compiled readers; see `FRAME`, `SLOT_FRAME` and their
        neighbours.
    pixels : ndarray, shape (slots, rows, columns)
        All slots, read-only for a reader.
    follower : ndarray, int64, shape (4,)
        Progress of the engine.
    """

    def __init__(
        self,
        name: str,
        memory: mmap.mmap,
        header: Header,
        identity: tuple[int, int],
        follower: NDArray[np.int64] | None = None,
    ) -> None:
        """Use `create` or `attach` instead."""
        self.name, self.slots = name, header.slots
        self.shape, self.dtype = (header.rows, header.columns), np.dtype(header.dtype)
        self.generation, self.creator_pid = header.generation, header.pid
        self._creator_start, self._identity = header.start, identity
        self.cells = cells_of(memory, header)
        self._flat = self.cells.reshape(-1)
        itemsize = self.dtype.itemsize
        self.pixels: NDArray[Any] = np.ndarray(
            (header.slots, *self.shape),
            self.dtype,
            memory,
            offset=header.first_pixel,
            strides=(header.slot_bytes, header.columns * itemsize, itemsize),
        )
        self.follower = follower_of(memory) if follower is None else follower
        self._writes = self.cells.flags.writeable
        self._open, self._follows = True, False

    @classmethod
    def create(cls, name: str, shape: tuple[int, int], dtype: DTypeLike, *, slots: int = 4) -> PixelRing:
        """Create a ring to write into.

        A ring of that name whose creator has died is replaced.

        Parameters
        ----------
        name : str
            Letters, digits, "_", "-" and "."; the segment is /dev/shm/name.
        shape : (int, int)
            Rows and columns of a frame.
        dtype : dtype
            Integers of up to 32 bits or floating point, native byte order.
        slots : int
            Frames in the ring, 2 to 1024: a frame can be read until slots - 1 more have begun.

        Raises
        ------
        InputError
            When a living process owns the name, something else has it, shared memory is short, or a value is
            out of range.
        """
        path = segment_path(name)
        header = new_header(shape, dtype, slots)
        memory, identity = create_segment(path, header)
        return cls(name, memory, header, identity)

    @classmethod
    def attach(cls, name: str, *, follows: bool = False) -> PixelRing:
        """Open a ring for reading; with `follows`, for the one reader that calls `follow`.

        Raises
        ------
        InputError
            When there is no such ring, or it is not a complete pixel ring of this version and user.
        """
        return cls(name, *open_segment(segment_path(name), follows))

    # ---- writer

    def begin(self, frame_number: int | None = None) -> NDArray[Any]:
        """Begin a frame and return its slot, (rows, columns), to be filled from row 0 on.

        `frame_number` may repeat or skip; by default it is one more than the last, from 0. A frame that is
        not ended stays incomplete.
        """
        if not (self._writes and self._open):
            raise InputError(f"pixel ring {self.name}: writable by its creator only, until closed")
        flat = self._flat
        number = self._look(FRAME) + 1 if frame_number is None else int(frame_number)
        if number < 0:
            raise InputError(f"frame_number = {number}: expected a number of at least 0")
        slot = number % self.slots
        header = (FIRST_SLOT + slot) * _LINE
        arrival = self._look(ARRIVALS) + 1
        # The order is the protocol: the slot's old frame number is cleared first, the new one is set last.
        store(flat, header + SLOT_FRAME, -1)
        store(flat, header + SLOT_TIME, 0)
        store(flat, header + SLOT_ARRIVAL, arrival)
        store(flat, ROWS * _LINE, 0)
        store(flat, header + SLOT_FRAME, number)
        store(flat, FRAME * _LINE, number)
        store(flat, ARRIVALS * _LINE, arrival)
        fence()  # before its first pixel is overwritten
        view: NDArray[Any] = self.pixels[slot]
        return view

    def rows_ready(self, rows: int) -> None:
        """Mark the first `rows` rows of the frame as complete."""
        number, before = self._look(FRAME), self._look(ROWS)
        if number < 0 or not before <= rows <= self.shape[0]:
            raise InputError(
                f"rows = {rows}: expected {before} to {self.shape[0]} rows of a frame that was begun"
            )
        if rows == self.shape[0]:
            header = FIRST_SLOT + number % self.slots
            store(self._flat, header * _LINE + SLOT_TIME, time.monotonic_ns())
        store(self._flat, ROWS * _LINE, rows)

    def end(self) -> None:
        """Mark the frame as complete."""
        if self._look(ROWS) < self.shape[0]:
            self.rows_ready(self.shape[0])

    def publish(self, frame: ArrayLike, frame_number: int | None = None) -> None:
        """Write a whole frame, for sources that do not deliver rows.

        Raises
        ------
        InputError
            When its shape is not the ring's; the ring does not change then.
        """
        array = np.asarray(frame)
        if array.shape != self.shape:
            raise InputError(f"frame: expected shape {self.shape}, got {array.shape}")
        self.begin(frame_number)[...] = array
        self.end()

    @property
    def followed(self) -> tuple[int, int] | None:
        """Arrivals that the engine has finished, and how many of them it lost; None without an engine.

        This asks the operating system, as `stale` does.
        """
        arrivals, lost, pid, start = (load(self.follower, cell) for cell in range(len(self.follower)))
        return (arrivals, lost) if pid and process_lives(pid, start) else None

    # ---- reader

    def follow(self, arrival: int, lost: int = 0) -> None:
        """Publish that this process has finished all frames up to an arrival and has lost `lost` of them."""
        store(self.follower, LOST, lost)
        store(self.follower, FOLLOWED, arrival)
        if not self._follows:
            self._follows = True
            store(self.follower, FOLLOWER_START, process_start(os.getpid()))
            store(self.follower, FOLLOWER, os.getpid())

    def unfollow(self) -> None:
        """Publish that this process measures no more frames of this ring."""
        self._follows = False
        store(self.follower, FOLLOWER, 0)

    @property
    def arrivals(self) -> int:
        """Frames begun since the ring was created; counts up even when a frame number repeats."""
        return self._look(ARRIVALS)

    @property
    def closed(self) -> bool:
        """Whether the writer has closed the ring."""
        return bool(self._look(CLOSED))

    @property
    def stale(self) -> bool:
        """Whether no more frames come: the creator has died, or the name leads to another ring or to none.

        This asks the operating system (tens of microseconds): do not use it for every frame.
        """
        try:
            named = identity_of(os.stat(FOLDER / self.name))
        except OSError:
            return True
        return named != self._identity or not process_lives(self.creator_pid, self._creator_start)

    def progress(self) -> tuple[int, int]:
        """Return the number of the arriving frame, -1 before the first, and the number of its complete rows.

        Between two frames it is briefly the last number with 0 rows; use `last_row_time_ns` to see whether a
        frame that is no longer arriving is complete.
        """
        while True:
            arrivals, frame, rows = self._look(ARRIVALS), self._look(FRAME), self._look(ROWS)
            if self._look(FRAME) == frame and self._look(ARRIVALS) == arrivals:
                return frame, rows

    def slot(self, frame: int) -> NDArray[Any]:
        """Return the slot (rows, columns) of a frame; check with `intact` after use that it still held it."""
        view: NDArray[Any] = self.pixels[frame % self.slots]
        return view

    def intact(self, frame: int, arrival: int | None = None) -> bool:
        """Return whether the slot still holds that frame, complete or arriving.

        If frame numbers may repeat, pass the number of its arrival, counted from 1.
        """
        fence()  # after the last pixel was read
        return self._holds(frame, arrival)

    def number_of(self, arrival: int) -> int:
        """Return the frame number of an arrival, counted from 1; -1 when no slot holds it."""
        for slot in range(FIRST_SLOT, FIRST_SLOT + self.slots):
            if self._look(slot, SLOT_ARRIVAL) == arrival:
                number = self._look(slot, SLOT_FRAME)
                return number if self._look(slot, SLOT_ARRIVAL) == arrival else -1
        return -1

    def last_row_time_ns(self, frame: int, arrival: int | None = None) -> int:
        """Return when a frame's last row was complete (CLOCK_MONOTONIC), 0 if it is incomplete or not held.

        If frame numbers may repeat, `arrival` selects one.
        """
        moment = self._look(FIRST_SLOT + frame % self.slots, SLOT_TIME)
        return moment if self._holds(frame, arrival) else 0

    def _holds(self, frame: int, arrival: int | None) -> bool:
        slot = FIRST_SLOT + frame % self.slots
        holds_frame = self._look(slot, SLOT_FRAME) == frame
        return holds_frame and (arrival is None or self._look(slot, SLOT_ARRIVAL) == arrival)

    # ---- both

    def _look(self, row: int, column: int = 0) -> int:
        """Return a cell; everything that its writer wrote before is visible from here on."""
        value: int = load(self._flat, row * _LINE + column)
        return value

    def close(self) -> None:
        """Close the ring; its creator also removes its name and notifies readers. Repeated calls do nothing.

        Views that are still in use keep their memory.
        """
        if not self._open:
            return
        self._open = False
        if self._writes and self.creator_pid == os.getpid():
            store(self._flat, CLOSED * _LINE, 1)
            path = FOLDER / self.name
            with suppress(OSError):
                if identity_of(path.stat()) == self._identity:
                    path.unlink()

    def __enter__(self) -> PixelRing:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
