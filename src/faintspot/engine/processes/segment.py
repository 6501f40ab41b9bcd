"""Segments of shared memory: rings of one process that lives, which any process of the same user may read.

Bytes from the start, of which everything but the first page begins at a page::

    0      magic, version, length and checksum of the header
    128    written by the one reader that is followed: see `FOLLOWED` and its neighbours
    4096   header, written once, JSON text: creator, what the segment is, its description
    then   cells of 8 bytes, 128 bytes apart to avoid sharing a cache line or a prefetched pair of lines; the
           first one is 1 when the writer has closed the segment
    then   the items of each ring

A segment gets its name when it is complete. Nothing is locked: see `faintspot.engine.frames.pixel_ring` and
`faintspot.engine.telemetry.ring` for the order in which items and cells are written.
"""

import fcntl
import mmap
import os
import re
import secrets
import stat
import struct
import time
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.base.files import Closing
from faintspot.base.text_files import parse_json, to_json
from faintspot.slopes.kernels.ordered import load, store

FOLDER = Path("/dev/shm")
"""Folder of named shared memory on Linux."""
CELL = 16
"""Distance of two cells, in numbers of 8 bytes."""
CLOSED = 0
FOLLOWED, LOST, FOLLOWER, FOLLOWER_START = range(4)
"""Places in `Segment.follower`: arrivals finished, frames lost, the reader's process (or 0), its start."""

_START = struct.Struct("<8sIII")
_MAGIC, _VERSION = b"faintspt", 1
_FOLLOWER_BYTE, _PAGE = 128, 4096
_READ = os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW  # neither block on a pipe nor follow a link
_LARGEST = 1 << 36


def process_start(pid: int) -> int:
    """Return when a process started, in clock ticks since boot; -1 if it does not exist or is dead.

    Process ids are reused; the pair of id and start time is not. A zombie, i.e. a killed process that its
    parent has not waited for, counts as dead. See proc_pid_stat(5), fields 3 and 22.
    """
    try:
        # The first thread's file holds the same: qemu-user makes up /proc/PID/stat for the process itself.
        text = Path(f"/proc/{pid}/task/{pid}/stat").read_text(encoding="ascii", errors="replace")
    except OSError:
        return -1
    # The second field is the program's name in parentheses, which may contain blanks and parentheses.
    fields = text.rpartition(")")[2].split()
    return -1 if fields[0] in "ZXx" else int(fields[19])


def process_lives(pid: int, start: int) -> bool:
    """Return whether the process with that id and start time is alive."""
    return start >= 0 and process_start(pid) == start


def process_age_s(pid: int) -> float:
    """Return how long ago a process started [s]; -1 if it does not exist or is dead."""
    start = process_start(pid)
    return -1.0 if start < 0 else time.clock_gettime(time.CLOCK_BOOTTIME) - start / os.sysconf("SC_CLK_TCK")


class Segment(Closing):
    """Rings in shared memory, readable and writable by the same user only. A context manager closes it.

    Attributes
    ----------
    name : str
        Name of the segment.
    description : dict
        The writer's description of itself, as plain values.
    creator_pid : int
        Process that created it.
    identity : (int, int)
        Device and inode, not used again while a process maps the segment.
    cells : ndarray, int64, shape (cells, CELL)
        The value is in column 0.
    rings : dict of str to structured array
        Places of each ring.
    follower : ndarray, int64, shape (4,)
        Progress of the reader that is followed.
    """

    what: ClassVar[str]
    writer: ClassVar[str]

    @classmethod
    def contents(cls, description: Mapping[str, object]) -> tuple[int, dict[str, tuple[np.dtype[Any], int]]]:
        """Return the number of cells, and the type and number of places of each ring."""
        raise NotImplementedError

    def __init__(
        self,
        path: Path,
        memory: mmap.mmap,
        header: Mapping[str, Any],
        status: os.stat_result,
        marks: Any = None,
    ) -> None:
        self.name, self._path, self.identity = path.name, path, identity_of(status)
        self.description: dict[str, Any] = header["description"]
        self.creator_pid, self._creator_start = header["pid"], header["start"]
        offsets, (cells, rings) = self._offsets(header), self.contents(self.description)
        self.cells: NDArray[np.int64] = np.ndarray((cells, CELL), np.int64, memory, next(offsets))
        self._flat = self.cells.reshape(-1)
        self.rings: dict[str, NDArray[Any]] = {
            name: np.ndarray(places, kind, memory, next(offsets)) for name, (kind, places) in rings.items()
        }
        self.follower: NDArray[np.int64] = np.ndarray(4, np.int64, marks or memory, _FOLLOWER_BYTE)
        self._is_open, self._writes = True, self.cells.flags.writeable

    @classmethod
    def _offsets(cls, header: Mapping[str, Any]) -> Iterator[int]:
        """Return where cells and rings begin, and at last the size of the segment."""
        cells, rings = cls.contents(header["description"])
        sizes = [8 * CELL * cells, *(kind.itemsize * places for kind, places in rings.values())]
        offset = header["begin"]
        for size in sizes:
            yield offset
            offset += up_to_pages(size)
        yield offset

    @classmethod
    def _created(cls, name: str, description: Mapping[str, object]) -> Self:
        """Create a segment; one of that name whose creator has died is replaced.

        Raises
        ------
        InputError
            When a living process or another object has the name, or shared memory is short.
        """
        path, pid = segment_path(name), os.getpid()
        header = {"what": cls.what, "pid": pid, "start": process_start(pid), "description": description}
        text = to_json(header).encode()
        header = {**parse_json(text), "begin": _PAGE + up_to_pages(len(text))}
        *_, size = cls._offsets(header)
        if size > _LARGEST:
            raise InputError(f"{cls.what}: expected at most 64 GiB, got {size / 2**30:.0f} GiB")
        cls._remove_dead(path)
        try:
            with new_memory(path, size) as (memory, hidden):
                np.frombuffer(memory, np.uint8)[::_PAGE] = 0  # touch every page before the first frame
                memory[_PAGE : _PAGE + len(text)] = text
                _START.pack_into(memory, 0, _MAGIC, _VERSION, len(text), zlib.crc32(text))
                segment = cls(path, memory, header, hidden.stat())
                segment._prepare()
                os.link(hidden, path)
                return segment
        except FileExistsError:
            raise InputError(f"{path}: another process is creating this {cls.what} too") from None
        except OSError as error:
            raise InputError(
                f"{path}: cannot be created, {size / 2**20:.1f} MiB ({error.strerror or error})"
            ) from None

    def _prepare(self) -> None:
        """Fill the cells of a new segment."""

    @classmethod
    def _attached(cls, name: str, *, follows: bool = False) -> Self:
        """Open a segment read-only; with `follows`, the follower's cells are writable.

        Raises
        ------
        InputError
            When there is no such segment, or it is not complete, or of another version or user.
        """
        path = segment_path(name)
        try:
            descriptor = os.open(path, _READ | os.O_RDWR if follows else _READ)
        except FileNotFoundError:
            raise InputError(f"{path}: no such {cls.what}; start the {cls.writer} first") from None
        except OSError as error:
            raise InputError(f"{path}: cannot be opened ({error.strerror or error})") from None
        try:
            header, status = cls._checked_header(path, descriptor), os.fstat(descriptor)
            *_, size = cls._offsets(header)
            if status.st_size != size:
                raise InputError(f"{path}: cut short: {status.st_size} of {size} bytes")
            memory = mmap.mmap(descriptor, size, access=mmap.ACCESS_READ)
            return cls(path, memory, header, status, mmap.mmap(descriptor, _PAGE) if follows else None)
        finally:
            os.close(descriptor)

    @classmethod
    def _checked_header(cls, path: Path, descriptor: int) -> dict[str, Any]:
        """Read the header of an open segment and check that it is private."""
        status = os.fstat(descriptor)
        start = os.pread(descriptor, _START.size, 0) if stat.S_ISREG(status.st_mode) else b""
        if len(start) < _START.size or not start.startswith(_MAGIC):
            raise InputError(f"{path}: expected a {cls.what}, got another file; choose another name")
        if status.st_uid != os.geteuid() or status.st_mode & 0o077:
            raise InputError(f"{path}: expected a segment that only you can open")
        _, version, length, checksum = _START.unpack(start)
        if version != _VERSION:
            raise InputError(f"{path}: has version {version}, expected {_VERSION}; restart its {cls.writer}")
        text = os.pread(descriptor, min(length, status.st_size), _PAGE)
        if zlib.crc32(text) != checksum:
            raise InputError(f"{path}: its header is damaged; restart its {cls.writer}")
        header: dict[str, Any] = {**parse_json(text), "begin": _PAGE + up_to_pages(length)}
        if header["what"] != cls.what:
            raise InputError(f"{path}: expected a {cls.what}, got a {header['what']}; choose another name")
        return header

    @classmethod
    def _remove_dead(cls, path: Path) -> None:
        """Remove the segment of a dead creator; refuse a living one's, and anything else."""
        try:
            descriptor = os.open(path, _READ)
        except FileNotFoundError:
            return
        except OSError as error:
            raise InputError(f"{path}: cannot be opened ({error.strerror or error})") from None
        try:
            header = cls._checked_header(path, descriptor)  # another user's file could stay locked
            # If several processes find it dead, one removes it; the others see that the name leads elsewhere.
            fcntl.flock(descriptor, fcntl.LOCK_EX)
            if process_lives(header["pid"], header["start"]):
                raise InputError(f"{path}: process {header['pid']} already writes into this {cls.what}")
            with suppress(FileNotFoundError):
                if identity_of(path.stat()) == identity_of(os.fstat(descriptor)):
                    path.unlink()
        finally:
            os.close(descriptor)

    @property
    def closed(self) -> bool:
        """Whether the writer has closed the segment."""
        return bool(self._look(CLOSED))

    @property
    def stale(self) -> bool:
        """Whether nothing more comes: the creator has ended, or the name leads to another segment or to none.

        What is there can still be read. This asks the operating system (tens of microseconds): do not use it
        for every frame.
        """
        try:
            named = identity_of(self._path.stat())
        except OSError:
            return True
        return named != self.identity or not process_lives(self.creator_pid, self._creator_start)

    def _look(self, row: int, column: int = 0) -> int:
        """Return a cell; everything that its writer wrote before is visible from here on."""
        value: int = load(self._flat, row * CELL + column)
        return value

    def close(self) -> None:
        """Close the segment; its creator also removes its name and notifies readers. Once is enough.

        Views that are still in use keep their memory.
        """
        if self._is_open and self._writes and self.creator_pid == os.getpid():
            store(self._flat, CLOSED, 1)
            with suppress(OSError):
                if identity_of(self._path.stat()) == self.identity:
                    self._path.unlink()
        self._is_open = False


def segment_path(name: str) -> Path:
    """Check the system and the name; return the path of a segment."""
    if not FOLDER.is_dir():
        raise InputError(f"shared memory: expected it at {FOLDER} (Linux)")
    if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z0-9_-][A-Za-z0-9_.-]{0,199}", name):
        raise InputError(f"name = {name!r}: expected up to 200 letters, digits, '_', '-' and '.'")
    return FOLDER / name


def identity_of(status: os.stat_result) -> tuple[int, int]:
    """Return the identity of a file, which is not reused while a process maps it."""
    return status.st_dev, status.st_ino


def up_to_pages(size: int) -> int:
    """Round a number of bytes up to whole pages."""
    return -(-size // _PAGE) * _PAGE


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
