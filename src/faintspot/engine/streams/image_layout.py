"""Memory layout of the streams of ImageStreamIO (milk, cacao): checked metadata, and semaphores.

Offsets and sizes hold for 64-bit Linux and follow the public header of version 2.00 (ImageStruct.h). A file
consists of metadata, values, keywords and the signals between readers and writers.
"""

import ctypes
import math
import os
import re
import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from faintspot.base.errors import InputError

SEMAPHORE_BYTES = 32
"""Size of a semaphore in memory (sem_t on 64-bit Linux)."""
_NAP_S = 5e-4

ISIO = "isio"
"""Kind of the streams, which begins their names: isio:NAME."""
VERSION = b"2.00"
SEMAPHORES, TRACES = 10, 10
"""Default numbers of semaphores and of entries in the write-trace table."""
MOST_POSTED = 10
"""Semaphore value up to which a publication posts."""
TYPES = {1: "u1", 2: "i1", 3: "u2", 4: "i2", 5: "u4", 6: "i4", 7: "u8", 8: "i8", 9: "f4", 10: "f8", 13: "f2"}
FLOAT32, MATH_DATA = 9, 2
_CIRCULAR, _KINDS_OF_IMAGE, _CIRCULAR_IN_TIME = 0x1, 0xF, (0xF000F, 0x20001)
_TRACE_BYTES, _CIRCULAR_FRAME_BYTES, _TIME_BYTES = 64, 48, 16
_LARGEST_BYTES = 1 << 36

_FIELDS = {
    "version": ("S32", 0),
    "name": ("S80", 32),
    "naxis": ("u1", 112),
    "size": ("3u4", 116),
    "nelement": ("u8", 128),
    "datatype": ("u1", 136),
    "imagetype": ("u8", 144),
    "creationtime": ("2i8", 152),
    "lastaccesstime": ("2i8", 168),
    "atime": ("2i8", 184),
    "writetime": ("2i8", 200),
    "creatorPID": ("i4", 216),
    "shared": ("u1", 224),
    "inode": ("u8", 232),
    "location": ("i1", 240),
    "sem": ("u2", 258),
    "NBproctrace": ("u2", 260),
    "cnt0": ("u8", 264),
    "cnt1": ("u8", 272),
    "write": ("u1", 288),
    "NBkw": ("u2", 290),
    "CBsize": ("u4", 292),
    "imdatamemsize": ("u8", 312),
}

COUNTER, WRITING = _FIELDS["cnt0"][1], _FIELDS["write"][1]
"""Byte offsets of the number of publications, and of the flag that a write is in progress."""


class _Time(ctypes.Structure):
    _fields_ = (("seconds", ctypes.c_int64), ("nanoseconds", ctypes.c_int64))


@cache
def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)


class Semaphore:
    """A semaphore at an address, which must stay mapped while it is used.

    Parameters
    ----------
    address : int
    """

    def __init__(self, address: int) -> None:
        self._at = ctypes.c_void_p(address)
        self._value = ctypes.c_int()

    @staticmethod
    def make(address: int) -> None:
        """Initialise a semaphore with the value 0."""
        _libc().sem_init(ctypes.c_void_p(address), 1, 0)

    @property
    def value(self) -> int:
        """Number of posts that were not waited for."""
        _libc().sem_getvalue(self._at, ctypes.byref(self._value))
        return self._value.value

    def post(self, most: int) -> None:
        """Post if the value is below `most`: there may be no process waiting."""
        if self.value < most:
            _libc().sem_post(self._at)

    def wait(self, limit_s: float) -> bool:
        """Wait for a post for up to `limit_s`; return whether there was one."""
        library = _libc()
        if hasattr(library, "sem_clockwait"):
            end = time.monotonic() + limit_s
            until = _Time(int(end), int(end % 1.0 * 1e9))
            return bool(library.sem_clockwait(self._at, time.CLOCK_MONOTONIC, ctypes.byref(until)) == 0)
        if library.sem_trywait(self._at) == 0:  # for older libraries, which wait on the wall clock
            return True
        time.sleep(min(limit_s, _NAP_S))
        return False


def _record(fields: Mapping[str, tuple[str, int]], size: int) -> np.dtype[np.void]:
    formats, offsets = zip(*fields.values(), strict=True)
    return np.dtype({"names": [*fields], "formats": formats, "offsets": offsets, "itemsize": size})


METADATA = _record(_FIELDS, 384)
KEYWORD = _record({"name": ("S16", 0), "type": ("S1", 16), "value": ("i8", 24), "cnt": ("u8", 40)}, 128)


@dataclass(frozen=True)
class Places:
    """Byte offsets of the parts of a file."""

    values: int
    keywords: int
    semaphores: int
    log_semaphore: int
    readers: int
    """Process numbers of the readers, one for each semaphore, int32."""
    writers: int
    total: int


class IncompatibleStreamError(Exception):
    """A stream that cannot be used; the text gives the reason, to follow "stream NAME: "."""


def places_of(metadata: Any) -> Places:
    """Return the offsets of the parts of a file with these metadata."""
    end = METADATA.itemsize

    def take(size: int) -> int:
        nonlocal end
        start = end
        end += -(-size // 8) * 8
        return start

    sizes = metadata["size"].tolist()
    data = math.prod(sizes[: metadata["naxis"]]) * np.dtype(TYPES[int(metadata["datatype"])]).itemsize
    values = take(data)
    keywords = take(KEYWORD.itemsize * int(metadata["NBkw"]))
    count = int(metadata["sem"])
    semaphores, log = take(SEMAPHORE_BYTES * count), take(SEMAPHORE_BYTES)
    readers, writers, *_ = (take(4 * count) for _ in range(4))
    take(_TRACE_BYTES * int(metadata["NBproctrace"]))
    mask, in_time = _CIRCULAR_IN_TIME
    if int(metadata["imagetype"]) & mask == in_time:
        for each in (_TIME_BYTES, _TIME_BYTES, 8):
            take(each * sizes[2])
    take(_CIRCULAR_FRAME_BYTES * int(metadata["CBsize"]))
    take(data * int(metadata["CBsize"]))
    return Places(values, keywords, semaphores, log, readers, writers, end)


def checked(metadata: Any, size: int) -> tuple[Places, tuple[int, ...], np.dtype[Any], bool]:
    """Check the metadata of a file of `size` bytes.

    Returns
    -------
    places : Places
    shape : tuple of int
        Shape in NumPy's order, the last axis the fastest; without the slices of a circular buffer.
    dtype : dtype
    circular : bool
        Whether the stream is a circular buffer, whose newest slice is `cnt1`.

    Raises
    ------
    IncompatibleStreamError
        When the metadata are not those of a supported stream.
    """
    if bytes(metadata["version"]) != VERSION:
        version = bytes(metadata["version"]).decode("ascii", "replace")
        raise IncompatibleStreamError(f"has version {version!r}, expected {VERSION.decode()!r}")
    axes, code = int(metadata["naxis"]), int(metadata["datatype"])
    sizes = [int(each) for each in metadata["size"][: min(axes, 3)]]
    if not 1 <= axes <= 3 or min(sizes) < 1 or math.prod(sizes) != int(metadata["nelement"]):
        raise IncompatibleStreamError(
            f"holds {axes} axes {sizes} of {int(metadata['nelement'])} values, expected 1 to 3 axes to match"
        )
    if code not in TYPES:
        raise IncompatibleStreamError(f"holds values of type {code}, expected real numbers")
    if int(metadata["location"]) != -1:
        raise IncompatibleStreamError("is in the memory of a GPU, expected CPU memory")
    places = places_of(metadata)
    if places.total != size or size > _LARGEST_BYTES:
        raise IncompatibleStreamError(
            f"has {size} bytes, expected {places.total} from its metadata; it may have another version"
        )
    circular = axes == 3 and int(metadata["imagetype"]) & _KINDS_OF_IMAGE == _CIRCULAR
    shape = tuple(sizes[1::-1]) if circular else tuple(sizes[::-1])
    return places, shape, np.dtype(TYPES[code]), circular


def path_of(name: str) -> Path:
    """Return the file of a stream, in the folder of ImageStreamIO.

    Raises
    ------
    InputError
        When the name is not valid.
    """
    if not re.fullmatch(r"[A-Za-z0-9_-][A-Za-z0-9_.-]{0,78}", name):
        raise InputError(f"{ISIO}:{name}: expected up to 79 letters, digits, '_', '-' and '.'")
    return _folder() / f"{name}.im.shm"


def _folder() -> Path:
    """Return the folder of ImageStreamIO's files."""
    chosen = os.environ.get("MILK_SHM_DIR")
    folders = [Path(chosen)] if chosen else []
    return next((each for each in (*folders, Path("/milk/shm")) if each.is_dir()), Path("/tmp"))
