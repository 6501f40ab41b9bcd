"""Shared-memory segment of a pixel ring: header, creation, opening and ownership."""

from __future__ import annotations

import fcntl
import mmap
import os
import re
import secrets
import stat
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import DTypeLike, NDArray

from faintspot.base.checks import number_between, numbers_between
from faintspot.base.errors import InputError
from faintspot.engine.pixels.processes import process_lives, process_start

FOLDER = Path("/dev/shm")
"""Folder of named shared memory on Linux."""

FRAME, ROWS, CLOSED, ARRIVALS, FIRST_SLOT = range(5)
"""Rows of `PixelRing.cells`; the value is in column 0."""
SLOT_FRAME, SLOT_ARRIVAL, SLOT_TIME = range(3)
"""Columns of `PixelRing.cells` from row FIRST_SLOT on."""
FOLLOWED, LOST, FOLLOWER, FOLLOWER_START = range(4)
"""Places in `PixelRing.follower`: arrivals finished, frames lost, the engine's process (or 0), its start."""

_MAGIC, _VERSION = b"fspixels", 1
_HEADER = struct.Struct("<8sIqqQqqq8s")
_CRC = struct.Struct("<I")
FIRST_CELL, CELL_BYTES, _ALIGNMENT = 256, 128, 4096
_FOLLOWER_BYTE = 128
_READ = os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW  # neither block on a pipe nor follow a link
_DTYPES = ("u1", "u2", "u4", "i2", "i4", "f4", "f8")
_LARGEST_SIDE, _LARGEST_RING = 1 << 16, 1 << 36


@dataclass(frozen=True)
class Header:
    """Header of a segment, written once: its creator and its contents.

    `pid` and `start` identify the creator, see `process_start`; `generation` differs each time.
    """

    pid: int
    start: int
    generation: int
    rows: int
    columns: int
    slots: int
    dtype: str

    def pack(self) -> bytes:
        """Return the header as bytes, with its checksum."""
        values = (self.pid, self.start, self.generation, self.rows, self.columns, self.slots)
        body = _HEADER.pack(_MAGIC, _VERSION, *values, self.dtype.encode("ascii"))
        return body + _CRC.pack(zlib.crc32(body))

    @classmethod
    def unpack(cls, raw: bytes, where: str) -> Header:
        """Read a header; raise InputError if it is not valid."""
        if len(raw) < _HEADER.size + _CRC.size or raw[:8] != _MAGIC:
            raise InputError(f"{where}: is not a pixel ring; choose another name")
        _magic, version, pid, start, generation, rows, columns, slots, dtype = _HEADER.unpack_from(raw)
        if version != _VERSION:
            raise InputError(
                f"{where}: pixel ring has version {version}, expected {_VERSION}; restart its writer"
            )
        if _CRC.unpack_from(raw, _HEADER.size)[0] != zlib.crc32(raw[: _HEADER.size]):
            raise InputError(f"{where}: the header of this pixel ring is damaged")
        pixel = dtype.rstrip(b"\0").decode("ascii")
        return cls(pid, start, generation, rows, columns, slots, pixel)

    @property
    def first_pixel(self) -> int:
        """Byte at which the slots start."""
        return _up_to(FIRST_CELL + (FIRST_SLOT + self.slots) * CELL_BYTES, _ALIGNMENT)

    @property
    def slot_bytes(self) -> int:
        """Bytes from one slot to the next."""
        return _up_to(self.rows * self.columns * np.dtype(self.dtype).itemsize, _ALIGNMENT)

    @property
    def total_bytes(self) -> int:
        """Bytes of the segment."""
        return self.first_pixel + self.slots * self.slot_bytes


def _up_to(size: int, multiple: int) -> int:
    return -(-size // multiple) * multiple


def identity_of(status: os.stat_result) -> tuple[int, int]:
    """Return a segment's identity, which is not reused while a process maps the segment."""
    return status.st_dev, status.st_ino


def segment_path(name: str) -> Path:
    """Check the system and the name; return the path of a segment."""
    if not FOLDER.is_dir():
        raise InputError(f"pixel ring: expected shared memory at {FOLDER} (Linux)")
    if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z0-9_-][A-Za-z0-9_.-]{0,199}", name):
        raise InputError(f"name = {name!r}: expected up to 200 letters, digits, '_', '-' and '.'")
    return FOLDER / name


def new_header(shape: tuple[int, int], dtype: DTypeLike, slots: int) -> Header:
    """Check the parameters of a ring; return the header for one that this process creates."""
    sides = numbers_between("shape", shape, 1, _LARGEST_SIDE, integer=True)
    if sides.shape != (2,):
        raise InputError(f"shape: expected (rows, columns), got shape {sides.shape}")
    pixel = np.dtype(dtype)
    if pixel.str[1:] not in _DTYPES or not pixel.isnative:
        raise InputError(f"dtype = {pixel.str}: expected one of {', '.join(_DTYPES)}, native byte order")
    count = int(number_between("slots", slots, 2, 1024, integer=True))
    pid = os.getpid()
    header = Header(
        pid, process_start(pid), secrets.randbits(64), int(sides[0]), int(sides[1]), count, pixel.str
    )
    if header.total_bytes > _LARGEST_RING:
        raise InputError(f"shape = {tuple(sides.tolist())}, slots = {count}: expected at most 64 GiB")
    return header


def create_segment(path: Path, header: Header) -> tuple[mmap.mmap, tuple[int, int]]:
    """Create a segment with its header and no frames; return its memory and identity.

    Raises
    ------
    InputError
        When a living process or another object has the name, or shared memory is short.
    """
    _remove_dead(path)
    try:
        with new_memory(path, header.total_bytes) as (memory, hidden):
            packed = header.pack()
            memory[: len(packed)] = packed
            cells = cells_of(memory, header)
            cells[FRAME, 0] = -1
            cells[FIRST_SLOT:, SLOT_FRAME] = -1
            os.link(hidden, path)
            return memory, identity_of(hidden.stat())
    except FileExistsError:
        raise InputError(f"{path}: another process is creating this pixel ring at the same time") from None
    except OSError as error:
        size = f"{header.total_bytes / 2**20:.1f} MiB"
        raise InputError(f"{path}: cannot be created, {size} ({error.strerror or error})") from None


@contextmanager
def new_memory(path: Path, size: int, mode: int = 0o600) -> Iterator[tuple[mmap.mmap, Path]]:
    """Make memory of a file under a hidden name, which is removed at the end; give both.

    A file is linked or renamed to its path when it is complete, so that nobody sees it before.
    """
    hidden = path.with_name(f".{path.name}.{secrets.token_hex(8)}")
    descriptor = os.open(hidden, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, mode)
    try:
        os.posix_fallocate(descriptor, 0, size)
        yield mmap.mmap(descriptor, size), hidden
    finally:
        hidden.unlink(missing_ok=True)
        os.close(descriptor)


def open_segment(path: Path, follows: bool) -> tuple[mmap.mmap, Header, tuple[int, int], NDArray[np.int64]]:
    """Open a segment read-only; return its memory, header, identity and the follower's cells.

    With `follows`, the follower's cells are writable.

    Raises
    ------
    InputError
        When there is no such segment, or it is not a complete pixel ring of this version and user.
    """
    try:
        descriptor = os.open(path, _READ | os.O_RDWR if follows else _READ)
    except FileNotFoundError:
        raise InputError(f"{path}: no such pixel ring; start the camera first") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be opened ({error.strerror or error})") from None
    try:
        header = _checked_header(path, descriptor)
        size = os.fstat(descriptor).st_size
        if size != header.total_bytes:
            raise InputError(f"{path}: cut short: {size} of {header.total_bytes} bytes")
        memory = mmap.mmap(descriptor, header.total_bytes, access=mmap.ACCESS_READ)
        marks = mmap.mmap(descriptor, FIRST_CELL) if follows else memory
        return memory, header, identity_of(os.fstat(descriptor)), follower_of(marks)
    finally:
        os.close(descriptor)


def follower_of(memory: mmap.mmap) -> NDArray[np.int64]:
    """Return the cells in which the engine publishes its progress."""
    return np.ndarray(4, np.int64, memory, offset=_FOLLOWER_BYTE)


def cells_of(memory: mmap.mmap, header: Header) -> NDArray[np.int64]:
    """Return the progress cells, (4 + slots, 16)."""
    shape = (FIRST_SLOT + header.slots, CELL_BYTES // 8)
    return np.ndarray(shape, np.int64, memory, offset=FIRST_CELL)


def _checked_header(path: Path, descriptor: int) -> Header:
    """Read the header of an open segment and check that it is private."""
    status = os.fstat(descriptor)
    if not stat.S_ISREG(status.st_mode):
        raise InputError(f"{path}: is not a pixel ring; choose another name")
    if status.st_uid != os.geteuid() or status.st_mode & 0o077:
        raise InputError(f"{path}: expected a segment that only you can open")
    header = Header.unpack(os.pread(descriptor, FIRST_CELL, 0), str(path))
    return header


def _remove_dead(path: Path) -> None:
    """Remove the ring of a dead creator; refuse a living one's, and anything else."""
    try:
        descriptor = os.open(path, _READ)
    except FileNotFoundError:
        return
    except OSError as error:
        raise InputError(f"{path}: cannot be opened ({error.strerror or error})") from None
    try:
        header = _checked_header(path, descriptor)  # another user's file could stay locked
        # If several processes find it dead, one removes it; the others see that the name leads elsewhere.
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        if process_lives(header.pid, header.start):
            raise InputError(f"{path}: process {header.pid} already writes into this pixel ring")
        with suppress(FileNotFoundError):
            if identity_of(path.stat()) == identity_of(os.fstat(descriptor)):
                path.unlink()
    finally:
        os.close(descriptor)
