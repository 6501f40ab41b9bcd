"""Streams of ImageStreamIO put together byte by byte, from the offsets of its public header."""

import ctypes
import mmap
import struct
from pathlib import Path
from typing import Any

import numpy as np

CODES = {"u1": 1, "i1": 2, "u2": 3, "i2": 4, "u4": 5, "i4": 6, "u8": 7, "i8": 8, "f4": 9, "f8": 10, "f2": 13}
LIBC = ctypes.CDLL(None)
SEMAPHORES, KEYWORDS, TRACES = 10, 2, 10


class IsioFile:
    """A file of ImageStreamIO, version 2.00, as milk makes one; sizes are (x, y, z)."""

    def __init__(self, path: Path, sizes: tuple[int, ...], dtype: str, **changes: Any) -> None:
        self.path, self.dtype = path, np.dtype(dtype)
        values = {
            "version": b"2.00",
            "sizes": sizes,
            "nelement": int(np.prod(sizes)),
            "code": CODES[dtype],
            "imagetype": 2,
            "location": -1,
            "pid": 0,
            "buffered": 0,
            **changes,
        }
        data = self._up(int(np.prod(sizes)) * self.dtype.itemsize)
        self.keywords = 384 + data
        self.semaphores = self.keywords + 128 * KEYWORDS
        self.log = self.semaphores + 32 * SEMAPHORES
        self.readers = self.log + 32
        self.writers = self.readers + 4 * SEMAPHORES
        end = self.writers + 3 * 4 * SEMAPHORES + 64 * TRACES
        if values["imagetype"] == 0x20001:
            end += (16 + 16 + 8) * sizes[2]
        end += self._up(48 * values["buffered"]) + self._up(data * values["buffered"])
        path.write_bytes(bytes(end))
        with path.open("r+b") as file:
            self.memory = mmap.mmap(file.fileno(), 0)
        put = self.put
        put(0, "32s", values["version"])
        put(32, "80s", path.name.removesuffix(".im.shm").encode())
        put(112, "B", values.get("naxis", len(sizes)))
        put(116, f"{len(sizes)}I", *sizes)
        put(128, "Q", values["nelement"])
        put(136, "B", values["code"])
        put(144, "Q", values["imagetype"])
        put(216, "i", values["pid"])
        put(224, "B", 1)
        put(240, "b", values["location"])
        put(258, "HH", SEMAPHORES, TRACES)
        put(290, "HI", KEYWORDS, values["buffered"])
        put(312, "Q", int(np.prod(sizes)) * self.dtype.itemsize)
        for number in range(SEMAPHORES):
            LIBC.sem_init(ctypes.c_void_p(self.address(number)), 1, 0)
            put(self.readers + 4 * number, "i", -1)

    def put(self, place: int, form: str, *values: Any) -> None:
        struct.pack_into("<" + form, self.memory, place, *values)

    def get(self, place: int, form: str) -> Any:
        return struct.unpack_from("<" + form, self.memory, place)[0]

    def address(self, number: int) -> int:
        start: int = np.frombuffer(self.memory, np.uint8).ctypes.data
        return start + self.semaphores + 32 * number

    def value(self, number: int) -> int:
        """Of a semaphore."""
        found = ctypes.c_int()
        LIBC.sem_getvalue(ctypes.c_void_p(self.address(number)), ctypes.byref(found))
        return found.value

    def write(self, values: Any, slice_number: int = 0, posts: bool = True) -> None:
        """Publish as ImageStreamIO does: flag, data, counters, flag, semaphores."""
        raw = np.asarray(values, self.dtype).tobytes()
        self.put(288, "B", 1)
        self.memory[384 + slice_number * len(raw) : 384 + (slice_number + 1) * len(raw)] = raw
        self.put(264, "QQ", self.get(264, "Q") + 1, slice_number)
        self.put(288, "B", 0)
        for number in range(SEMAPHORES if posts else 0):
            if self.value(number) < 10:
                LIBC.sem_post(ctypes.c_void_p(self.address(number)))

    @staticmethod
    def _up(size: int) -> int:
        return -(-size // 8) * 8
