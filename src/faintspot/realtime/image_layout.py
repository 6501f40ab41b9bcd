"""Where things are in the shared memory of ImageStreamIO (milk, cacao) and dao, checked at the door.

These are offsets and sizes on 64-bit Linux, as the public headers of both give them: version 2.00 of
ImageStreamIO (ImageStruct.h), and dao's daoImageStruct.h, which has no version. A file is a block of
metadata, the values, keywords and, in ImageStreamIO, what readers and writers tell each other.
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
from faintspot.realtime.semaphores import BYTES as SEMAPHORE_BYTES

ISIO, DAO = "isio", "dao"
VERSION = b"2.00"
"""Of ImageStreamIO."""
SEMAPHORES, TRACES = 10, 10
"""As both make them; entries of ImageStreamIO's table of who triggered whom."""
MOST_POSTED = {ISIO: 10, DAO: 1}
"""A semaphore is not posted beyond."""
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
"""Byte offsets of what is looked at again and again."""
METADATA = {ISIO: _record(_ISIO_FIELDS, 384), DAO: _record(_DAO_FIELDS, 4296)}
KEYWORD = {
    ISIO: _record({"name": ("S16", 0), "type": ("S1", 16), "value": ("i8", 24), "cnt": ("u8", 40)}, 128),
    DAO: _record({"name": ("S16", 0), "type": ("S1", 16), "value": ("i8", 24)}, 120),
}


@dataclass(frozen=True)
class Places:
    """Byte offsets of the parts of a file; -1 for what it has not."""

    values: int
    keywords: int
    semaphores: int
    log_semaphore: int
    readers: int
    """Of process numbers, one for each semaphore, int32."""
    writers: int
    total: int


class IncompatibleStreamError(Exception):
    """What is there is no stream that can be used; the text says why, after "stream NAME: "."""


def places_of(kind: str, metadata: Any) -> Places:
    """Return where the parts of a file with these metadata are."""
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
        As NumPy has it, the last axis the fastest; without the slices of a circular buffer.
    dtype : dtype
    circular : bool
        Whether the slice `cnt1` is the newest.

    Raises
    ------
    IncompatibleStreamError
        Where something does not fit.
    """
    if kind == ISIO and bytes(metadata["version"]) != VERSION:
        version = bytes(metadata["version"]).decode("ascii", "replace")
        raise IncompatibleStreamError(f"is of version {version!r}, expected {VERSION.decode()!r}")
    axes, code = int(metadata["naxis"]), int(metadata["datatype"])
    sizes = [int(each) for each in metadata["size"][: min(axes, 3)]]
    if not 1 <= axes <= 3 or min(sizes) < 1 or math.prod(sizes) != int(metadata["nelement"]):
        raise IncompatibleStreamError(
            f"holds {axes} axes {sizes} of {int(metadata['nelement'])} values, which is no stream"
        )
    if code not in TYPES:
        raise IncompatibleStreamError(f"holds values of type {code}, expected real numbers")
    if kind == ISIO and int(metadata["location"]) != -1:
        raise IncompatibleStreamError("is in the memory of a GPU, expected that of the processor")
    places = places_of(kind, metadata)
    if places.total != size or size > _LARGEST_BYTES:
        raise IncompatibleStreamError(
            f"has {size} bytes, expected {places.total} for its metadata: it is of another version"
        )
    circular = kind == ISIO and axes == 3 and int(metadata["imagetype"]) & _KINDS_OF_IMAGE == _CIRCULAR
    shape = tuple(sizes[1::-1]) if circular else tuple(sizes[::-1])
    return places, shape, np.dtype(TYPES[code]), circular


def path_of(kind: str, name: str) -> Path:
    """Return the file of a stream: NAME of ImageStreamIO in its folder, a path or NAME in /tmp of dao.

    Raises
    ------
    InputError
        For a name that neither takes.
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
    """Where ImageStreamIO keeps its files."""
    chosen = os.environ.get("MILK_SHM_DIR")
    folders = [Path(chosen)] if chosen else []
    return next((each for each in (*folders, Path("/milk/shm")) if each.is_dir()), Path("/tmp"))
