"""POSIX semaphores in shared memory, that other programs post and wait for."""

from __future__ import annotations

import ctypes
import time
from functools import cache

BYTES = 32
"""Size of a semaphore in memory (sem_t on 64-bit Linux)."""
_NAP_S = 5e-4


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
