"""Streams of ImageStreamIO (milk, cacao) in shared memory: frames in, slopes and commands out."""

import contextlib
import math
import mmap
import os
import stat
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.engine.processes.segment import identity_of, new_memory, process_start
from faintspot.engine.streams import image_layout as layout
from faintspot.slopes.kernels.ordered import fence, load, store

LARGEST_NUMBER = 2**63 - 1
"""Largest frame number."""


class Publication(NamedTuple):
    """Values that were published together."""

    values: NDArray[Any]
    number: int
    """Frame number given by the producer."""
    total: int
    """Number of publications up to this one."""


_NAP_S = 5e-4
_OPEN = os.O_NONBLOCK | os.O_CLOEXEC  # never block on a named pipe


class _Mapped:
    """A memory-mapped stream, with its parts as arrays."""

    def __init__(self, memory: mmap.mmap, places: layout.Places, shape: tuple[int, ...]) -> None:
        self.fields = np.ndarray((), layout.METADATA, memory)
        """Metadata as arrays, which change when other processes write."""
        self.memory, self.places = memory, places
        self.counter = np.ndarray((1,), np.int64, memory, layout.COUNTER)
        self.writing = np.ndarray((), np.uint8, memory, layout.WRITING)
        dtype = np.dtype(layout.TYPES[int(self.fields["datatype"])])
        self.values: NDArray[Any] = np.ndarray(shape, dtype, memory, places.values)
        self.address = np.frombuffer(memory, np.uint8).ctypes.data

    def pids(self, offset: int) -> NDArray[np.int32]:
        """Return the process numbers, one for each semaphore."""
        return np.ndarray((int(self.fields["sem"]),), np.int32, self.memory, offset)

    def semaphore(self, number: int) -> int:
        """Return the address of a semaphore in memory."""
        return self.address + self.places.semaphores + layout.SEMAPHORE_BYTES * number


class ImageStream:
    """A stream that another program writes, with the interface of `faintspot.engine.streams.stream.Stream`.

    To wait, it takes a free semaphore. A publication's number is the counter minus one.

    Parameters
    ----------
    name : str
        See `path_of`.

    Raises
    ------
    FileNotFoundError
        When the stream does not exist.
    IncompatibleStreamError
        When the file is not a usable stream.
    InputError
        When the name is not valid.
    """

    def __init__(self, name: str) -> None:
        self._path = layout.path_of(name)
        try:
            descriptor = os.open(self._path, os.O_RDWR | _OPEN)
            writable = True
        except PermissionError:
            descriptor, writable = os.open(self._path, os.O_RDONLY | _OPEN), False
        try:
            status = os.fstat(descriptor)
            size, metadata = status.st_size, _metadata_of(descriptor, status)
            places, self.shape, self.dtype, self._circular = layout.checked(metadata, size)
            access = mmap.ACCESS_WRITE if writable else mmap.ACCESS_READ
            memory = mmap.mmap(descriptor, size, access=access)
        except BaseException:
            os.close(descriptor)
            raise
        self._descriptor, self._size, self._identity = descriptor, size, identity_of(status)
        whole = (int(metadata["size"][2]), *self.shape) if self._circular else self.shape
        self._mapped = _Mapped(memory, places, whole)
        self._maker = int(metadata["creatorPID"])
        self._turn = self._claimed() if writable else None

    @property
    def count(self) -> int:
        """Number of publications."""
        count: int = load(self._mapped.counter, 0) % 2**64  # unsigned in the file
        return count

    @property
    def number(self) -> int:
        """Number of the newest frame."""
        return _number(self.count)

    @property
    def maker(self) -> str:
        """Process that made the stream, in words."""
        return f"pid {self._maker}" if self._maker else str(self._path)

    def maker_lives(self) -> bool | None:
        """Return whether that process is alive; None if it is not known."""
        return process_start(self._maker) >= 0 if self._maker else None

    def same(self) -> bool | None:
        """Return whether the name still leads to this stream; None if it leads nowhere."""
        try:
            status = self._path.stat()
        except OSError:
            return None
        return identity_of(status) == self._identity and status.st_size == self._size

    def wait(self, after: int, limit_s: float) -> bool:
        """Wait up to `limit_s` until more than `after` publications exist; return whether they do.

        The counter is also polled every half millisecond, because not every program posts semaphores.
        """
        end = time.monotonic() + limit_s
        while self.count == after:
            if time.monotonic() >= end:
                return False
            if self._turn is None:
                time.sleep(_NAP_S)
            else:
                layout.Semaphore(self._mapped.semaphore(self._turn)).wait(_NAP_S)
        return True

    def read(self, out: NDArray[np.generic] | None = None, limit_s: float = 0.0) -> Publication | None:
        """Return the newest publication, or None when no complete one can be read in time."""
        mapped, end = self._mapped, time.monotonic() + limit_s
        target = np.empty(self.shape, self.dtype) if out is None else out
        while os.fstat(self._descriptor).st_size == self._size:  # reading beyond a file's end is fatal
            count, writing = self.count, bool(mapped.writing)
            fence()
            if not writing:
                newest = mapped.values[int(mapped.fields["cnt1"]) % len(mapped.values)]
                np.copyto(target, newest if self._circular else mapped.values, casting="unsafe")
                fence()
                if not mapped.writing and self.count == count:
                    return Publication(target, _number(count), count)
            if time.monotonic() >= end:
                break
        return None

    def close(self) -> None:
        """Release the semaphore and close the stream."""
        if self._turn is not None:
            self._mapped.pids(self._mapped.places.readers)[self._turn] = 0
            self._turn = None
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1

    def _claimed(self) -> int | None:
        """Register this process as the reader of a semaphore that no living process has."""
        readers = self._mapped.pids(self._mapped.places.readers)
        for number, pid in enumerate(readers.tolist()):
            if pid <= 0 or process_start(pid) < 0:
                readers[number] = os.getpid()
                return number
        return None


class ImageStreamWriter:
    """A stream that faintspot writes for programs of ImageStreamIO.

    Each publication increments `cnt0` and posts all semaphores. The keyword FRAME is the frame's number;
    times are those of publication (TAI). An existing stream is recreated unless its maker is alive.

    Parameters
    ----------
    name : str
        See `path_of`.
    shape : (int,) or (int, int)
        Shape of the values, float32; a vector becomes an image of one row.

    Raises
    ------
    InputError
        When a living process made a stream of that name, the file is something else, or it cannot be made.
    """

    def __init__(self, name: str, shape: tuple[int, ...]) -> None:
        self.path = layout.path_of(name)
        self.shape = (1, *shape) if len(shape) == 1 else shape
        head = self._head()
        _check_free(self.path)
        self._mapped = self._made(head, layout.places_of(head))
        self._identity = identity_of(self.path.stat())
        self._keyword: Any = np.ndarray((), layout.KEYWORD, self._mapped.memory, self._mapped.places.keywords)
        self._keyword["name"], self._keyword["type"] = b"FRAME", b"L"
        log = layout.Semaphore(self._mapped.address + self._mapped.places.log_semaphore)
        self._semaphores = [
            *(layout.Semaphore(self._mapped.semaphore(each)) for each in range(layout.SEMAPHORES)),
            log,
        ]

    def publish(self, values: NDArray[np.generic], number: int) -> None:
        """Publish the values of a frame."""
        mapped, fields = self._mapped, self._mapped.fields
        mapped.writing[...] = 1
        fence()
        mapped.values[...] = values.reshape(self.shape)
        self._keyword["value"] = number
        self._keyword["cnt"] += 1
        fields["atime"] = fields["writetime"] = _clock()
        store(mapped.counter, 0, load(mapped.counter, 0) + 1)
        fence()
        mapped.writing[...] = 0
        for semaphore in self._semaphores:
            semaphore.post(layout.MOST_POSTED)

    def close(self) -> None:
        """Remove the stream, unless another process has replaced it."""
        with contextlib.suppress(OSError):
            if identity_of(self.path.stat()) == self._identity:
                self.path.unlink()

    def _made(self, head: NDArray[Any], places: layout.Places) -> _Mapped:
        """Make the stream's file."""
        try:
            with new_memory(self.path, places.total, 0o666) as (memory, hidden):
                head["inode"] = hidden.stat().st_ino
                memory[: head.nbytes] = head.tobytes()
                mapped = _Mapped(memory, places, self.shape)
                for number in range(layout.SEMAPHORES):
                    layout.Semaphore.make(mapped.semaphore(number))
                layout.Semaphore.make(mapped.address + places.log_semaphore)
                mapped.pids(places.readers)[:] = -1
                mapped.pids(places.writers)[:] = os.getpid()
                os.replace(hidden, self.path)
                return mapped
        except OSError as error:
            raise InputError(
                f"{self.path}: this stream cannot be made: {places.total} bytes ({error.strerror})"
            ) from None

    def _head(self) -> NDArray[np.generic]:
        """Return the metadata of a new stream."""
        head = np.zeros((), layout.METADATA)
        head["naxis"], head["size"] = 2, (*self.shape[::-1], 0)
        head["nelement"], head["datatype"] = math.prod(self.shape), layout.FLOAT32
        head["shared"], head["sem"], head["NBkw"] = 1, layout.SEMAPHORES, 1
        head["name"] = self.path.name.removesuffix(".im.shm").encode()
        head["version"], head["imagetype"], head["location"] = layout.VERSION, layout.MATH_DATA, -1
        head["NBproctrace"], head["creatorPID"] = layout.TRACES, os.getpid()
        head["imdatamemsize"] = 4 * math.prod(self.shape)
        head["creationtime"] = head["lastaccesstime"] = _clock()
        return head


def _number(count: int) -> int:
    """Return the number of the last published frame."""
    return max(count - 1, 0) & LARGEST_NUMBER


def _check_free(path: Path) -> None:
    """Check that there is no file, or a stream that may be replaced.

    Raises
    ------
    InputError
        When the file is something else, or its maker is alive.
    """
    try:
        descriptor = os.open(path, os.O_RDWR | _OPEN)
    except FileNotFoundError:
        return
    except OSError as error:
        raise InputError(f"{layout.ISIO}:{path}: cannot be opened ({error.strerror})") from None
    try:
        status = os.fstat(descriptor)
        head = _metadata_of(descriptor, status)
        layout.checked(head, status.st_size)
    except layout.IncompatibleStreamError as error:
        raise InputError(f"{layout.ISIO}:{path}: {error}; remove it or choose another name") from None
    finally:
        os.close(descriptor)
    maker = int(head["creatorPID"])
    if maker not in (0, os.getpid()) and process_start(maker) >= 0:
        raise InputError(
            f"{layout.ISIO}:{path}: a living process made this stream (pid {maker}); stop it "
            "or choose another name"
        )


def _metadata_of(descriptor: int, status: os.stat_result) -> Any:
    """Return the metadata of an open file; refuse what can have none."""
    if not stat.S_ISREG(status.st_mode) or status.st_size <= layout.METADATA.itemsize:
        raise layout.IncompatibleStreamError("is not a stream")
    return np.frombuffer(os.pread(descriptor, layout.METADATA.itemsize, 0), layout.METADATA)[0]


def _clock() -> tuple[int, int]:
    """Return seconds and nanoseconds of the clock that ImageStreamIO uses."""
    return divmod(time.clock_gettime_ns(time.CLOCK_TAI), 10**9)
