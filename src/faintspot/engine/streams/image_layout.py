"""Memory layout of the streams of ImageStreamIO (milk, cacao) and dao, with checks of their metadata.

Offsets and sizes hold for 64-bit Linux and follow the public headers: version 2.00 of ImageStreamIO
(ImageStruct.h), and dao's daoImageStruct.h, which has no version. A file consists of metadata, values,
keywords and, in ImageStreamIO, the signals between readers and writers.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from faintspot.base.errors import InputError
from faintspot.engine.streams.semaphores import BYTES as SEMAPHORE_BYTES

ISIO, DAO = "isio", "dao"
VERSION = b"2.00"
"""Version of ImageStreamIO."""
SEMAPHORES, TRACES = 10, 10
"""Default numbers of semaphores and of entries in ImageStreamIO's write-trace table."""
MOST_POSTED = {ISIO: 10, DAO: 1}
"""Semaphore value up to which a publication posts."""
TYPES = {1: "u1", 2: "i1", 3: "u2", 4: "i2", 5: "u4", 6: "i4", 7: "u8", 8: "i8", 9: "f4", 10: "f8", 13: "f2"}
MATH_DATA = 2
_CIRCULAR, _KINDS_OF_IMAGE, _CIRCULAR_IN_TIME = 0x1, 0xF, (0xF000F, 0x20001)
_TRACE_BYTES, _CIRCULAR_FRAME_BYTES, _TIME_BYTES = 64, 48, 16
_LARGEST_BYTES = 1 << 36

_ISIO_FIELDS = {
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
_DAO_FIELDS = {
    "name": ("S80", 0),
    "naxis": ("u1", 80),
    "size": ("3u4", 84),
    "nelement": ("u8", 96),
    "datatype": ("u1", 104),
    "atime": ("2i8", 128),
    "shared": ("u1", 144),
    "sem": ("u2", 148),
    "cnt0": ("u8", 152),
    "cnt1": ("u8", 160),
    "write": ("u1", 176),
    "NBkw": ("u2", 178),
}


def _record(fields: Mapping[str, tuple[str, int]], size: int) -> np.dtype[np.void]:
    formats, offsets = zip(*fields.values(), strict=True)
    return np.dtype({"names": [*fields], "formats": formats, "offsets": offsets, "itemsize": size})


COUNTER = {ISIO: _ISIO_FIELDS["cnt0"][1], DAO: _DAO_FIELDS["cnt0"][1]}
WRITING = {ISIO: _ISIO_FIELDS["write"][1], DAO: _DAO_FIELDS["write"][1]}
"""Byte offsets of the flag that a write is in progress."""
METADATA = {ISIO: _record(_ISIO_FIELDS, 384), DAO: _record(_DAO_FIELDS, 4296)}
KEYWORD = {
    ISIO: _record({"name": ("S16", 0), "type": ("S1", 16), "value": ("i8", 24), "cnt": ("u8", 40)}, 128),
    DAO: _record({"name": ("S16", 0), "type": ("S1", 16), "value": ("i8", 24)}, 120),
}


@dataclass(frozen=True)
class Places:
    """Byte offsets of the parts of a file; -1 for missing parts."""

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


def places_of(kind: str, metadata: Any) -> Places:
    """Return the offsets of the parts of a file with these metadata."""
    end = METADATA[kind].itemsize

    def take(size: int) -> int:
        nonlocal end
        start = end
        end += size if kind == DAO else -(-size // 8) * 8
        return start

    sizes = metadata["size"].tolist()
    data = math.prod(sizes[: metadata["naxis"]]) * np.dtype(TYPES[int(metadata["datatype"])]).itemsize
    values = take(data)
    keywords = take(KEYWORD[kind].itemsize * int(metadata["NBkw"]))
    if kind == DAO:
        return Places(values, keywords, -1, -1, -1, -1, end)
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


def checked(kind: str, metadata: Any, size: int) -> tuple[Places, tuple[int, ...], np.dtype[Any], bool]:
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
    if kind == ISIO and bytes(metadata["version"]) != VERSION:
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
    if kind == ISIO and int(metadata["location"]) != -1:
        raise IncompatibleStreamError("is in the memory of a GPU, expected CPU memory")
    places = places_of(kind, metadata)
    if places.total != size or size > _LARGEST_BYTES:
        raise IncompatibleStreamError(
            f"has {size} bytes, expected {places.total} from its metadata; it may have another version"
        )
    circular = kind == ISIO and axes == 3 and int(metadata["imagetype"]) & _KINDS_OF_IMAGE == _CIRCULAR
    shape = tuple(sizes[1::-1]) if circular else tuple(sizes[::-1])
    return places, shape, np.dtype(TYPES[code]), circular


def path_of(kind: str, name: str) -> Path:
    """Return the file of a stream: NAME in ImageStreamIO's folder, or for dao a path or NAME in /tmp.

    Raises
    ------
    InputError
        When the name is not valid.
    """
    if kind == DAO and "/" in name:
        path = Path(name)
    else:
        if not re.fullmatch(r"[A-Za-z0-9_-][A-Za-z0-9_.-]{0,78}", name):
            raise InputError(f"{kind}:{name}: expected up to 79 letters, digits, '_', '-' and '.'")
        path = (_folder() if kind == ISIO else Path("/tmp")) / f"{name}.im.shm"
    if kind == DAO and (len(str(path)) > 79 or not path.name.split(".")[0]):
        raise InputError(f"{kind}:{name}: expected a path of up to 79 characters, as /tmp/NAME.im.shm")
    return path


def _folder() -> Path:
    """Return the folder of ImageStreamIO's files."""
    chosen = os.environ.get("MILK_SHM_DIR")
    folders = [Path(chosen)] if chosen else []
    return next((each for each in (*folders, Path("/milk/shm")) if each.is_dir()), Path("/tmp"))
