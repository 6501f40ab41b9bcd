"""Transfer of pixels from a camera to the engine, row by row, through a ring of frames in shared memory.

One process writes; any number of processes of the same user read. A camera never waits for a reader. After
using pixels, a reader checks with `PixelRing.intact` whether they were overwritten meanwhile. One reader, the
engine, publishes its position (`PixelRing.follow`), so that a writer that can wait loses no frame.

The cells of the segment (see `faintspot.engine.processes.segment`) are: closed, arriving frame, its complete
rows, arrivals (frames begun so far), then one for each slot with the frame number (-1 while it is replaced),
arrival and time of the last row. Frame n lies in slot n % slots.

The writer stores pixels first and progress afterwards, each number as one aligned 8-byte store. The reader
loads progress first, and checks the slot's cell again after using the pixels.
`faintspot.slopes.kernels.ordered` enforces this order on processors with weaker memory ordering.
"""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from faintspot.base.checks import number_between, numbers_between
from faintspot.base.errors import InputError
from faintspot.engine.processes import segment
from faintspot.slopes.kernels.ordered import fence, load, store

FRAME, ROWS, ARRIVALS, FIRST_SLOT = range(1, 5)
"""Rows of `PixelRing.cells`; the value is in column 0."""
SLOT_FRAME, SLOT_ARRIVAL, SLOT_TIME = range(3)
"""Columns of `PixelRing.cells` from row FIRST_SLOT on."""

_DTYPES = ("u1", "u2", "u4", "i2", "i4", "f4", "f8")
_LARGEST_SIDE = 1 << 16


class PixelRing(segment.Segment):
    """A ring of frames in shared memory, made by `create` (the writer) or `attach` (a reader).

    Attributes
    ----------
    shape : (int, int)
        Rows and columns of a frame.
    dtype : numpy.dtype
    slots : int
        Frames in the ring.
    pixels : ndarray, shape (slots, rows, columns)
        All slots, read-only for a reader.
    """

    what, writer = "pixel ring", "camera"

    def __init__(self, *parts: Any) -> None:
        """Use `create` or `attach` instead."""
        super().__init__(*parts)
        rows, columns = self.description["shape"]
        self.shape, self.slots = (rows, columns), self.description["slots"]
        self.dtype = np.dtype(self.description["dtype"])
        strides = _slot_bytes(self.description), columns * self.dtype.itemsize, self.dtype.itemsize
        self.pixels: NDArray[Any] = np.ndarray(
            (self.slots, rows, columns), self.dtype, self.rings["pixels"].data, strides=strides
        )
        self._follows = False

    @classmethod
    def contents(cls, description: Mapping[str, Any]) -> tuple[int, dict[str, tuple[np.dtype[Any], int]]]:
        """See `Segment`."""
        slots = description["slots"]
        return FIRST_SLOT + slots, {"pixels": (np.dtype(np.uint8), slots * _slot_bytes(description))}

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
        sides = numbers_between("shape", shape, 1, _LARGEST_SIDE, integer=True)
        if sides.shape != (2,):
            raise InputError(f"shape: expected (rows, columns), got shape {sides.shape}")
        pixel = np.dtype(dtype)
        if pixel.str[1:] not in _DTYPES or not pixel.isnative:
            raise InputError(f"dtype = {pixel.str}: expected one of {', '.join(_DTYPES)}, native byte order")
        count = int(number_between("slots", slots, 2, 1024, integer=True))
        return cls._created(name, {"shape": sides.astype(int), "dtype": pixel.str, "slots": count})

    def _prepare(self) -> None:
        self.cells[FRAME, 0] = -1
        self.cells[FIRST_SLOT:, SLOT_FRAME] = -1

    @classmethod
    def attach(cls, name: str, *, follows: bool = False) -> PixelRing:
        """Open a ring for reading; with `follows`, for the one reader that calls `follow`.

        Raises
        ------
        InputError
            When there is no such ring, or it is not a complete pixel ring of this version and user.
        """
        return cls._attached(name, follows=follows)

    # ---- writer

    def begin(self, frame_number: int | None = None) -> NDArray[Any]:
        """Begin a frame and return its slot, (rows, columns), to be filled from row 0 on.

        `frame_number` may repeat or skip; by default it is one more than the last, from 0. A frame that is
        not ended stays incomplete.
        """
        if not (self._writes and self._is_open):
            raise InputError(f"pixel ring {self.name}: writable by its creator only, until closed")
        flat = self._flat
        number = self._look(FRAME) + 1 if frame_number is None else int(frame_number)
        if number < 0:
            raise InputError(f"frame_number = {number}: expected a number of at least 0")
        slot = number % self.slots
        header = (FIRST_SLOT + slot) * segment.CELL
        arrival = self._look(ARRIVALS) + 1
        # The order is the protocol: the slot's old frame number is cleared first, the new one is set last.
        store(flat, header + SLOT_FRAME, -1)
        store(flat, header + SLOT_TIME, 0)
        store(flat, header + SLOT_ARRIVAL, arrival)
        store(flat, ROWS * segment.CELL, 0)
        store(flat, header + SLOT_FRAME, number)
        store(flat, FRAME * segment.CELL, number)
        store(flat, ARRIVALS * segment.CELL, arrival)
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
            store(self._flat, header * segment.CELL + SLOT_TIME, time.monotonic_ns())
        store(self._flat, ROWS * segment.CELL, rows)

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
        return (arrivals, lost) if pid and segment.process_lives(pid, start) else None

    # ---- reader

    def follow(self, arrival: int, lost: int = 0) -> None:
        """Publish that this process has finished all frames up to an arrival and has lost `lost` of them."""
        store(self.follower, segment.LOST, lost)
        store(self.follower, segment.FOLLOWED, arrival)
        if not self._follows:
            self._follows = True
            store(self.follower, segment.FOLLOWER_START, segment.process_start(os.getpid()))
            store(self.follower, segment.FOLLOWER, os.getpid())

    def unfollow(self) -> None:
        """Publish that this process measures no more frames of this ring."""
        self._follows = False
        store(self.follower, segment.FOLLOWER, 0)

    @property
    def arrivals(self) -> int:
        """Frames begun since the ring was created; counts up even when a frame number repeats."""
        return self._look(ARRIVALS)

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


def _slot_bytes(description: Mapping[str, Any]) -> int:
    """Return the bytes from one slot to the next, whole pages."""
    rows, columns = description["shape"]
    return segment.up_to_pages(rows * columns * np.dtype(description["dtype"]).itemsize)


def living_ring(name: str, shape: tuple[int, int]) -> tuple[PixelRing | None, str]:
    """Return the ring of a source that is alive, and a description of its frames if they do not fit.

    Without a ring, or if frames are not of this shape and uint16 or float32, there is None.
    """
    try:
        ring = PixelRing.attach(name, follows=True)
    except InputError:
        return None, ""
    if ring.stale or ring.closed:
        return None, ""
    if ring.shape == shape and ring.dtype in (np.uint16, np.float32):
        return ring, ""
    return None, (
        f"frames of {ring.shape[0]} x {ring.shape[1]} pixels, {ring.dtype}; "
        f"expected {shape[0]} x {shape[1]}, uint16 or float32"
    )
