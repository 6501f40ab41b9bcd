"""Disk cache of compiled kernels; if it cannot be used, a warning is given once."""

from __future__ import annotations

import hashlib
import logging
import warnings
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from typing import Any

from numba.core.caching import FunctionCache, IndexDataCacheFile, NullCache

from faintspot.base.errors import CacheWarning


def kernel_cache(function: Callable[..., Any], stamp: Any) -> Any:
    """Return the cache of a function's machine code, valid as long as `stamp` is the same.

    Numba's own cache asks only whether the function's own file has changed, but kernels inline each other
    across files.
    """
    try:
        return _KernelCache(function, stamp)
    except RuntimeError:  # neither in NUMBA_CACHE_DIR, nor beside the sources, nor in the user's folder
        _warn_once("no folder for them can be written")
        return NullCache()


class _KernelCache(FunctionCache):
    """Numba's cache, tolerant of a disk that is full, read-only or damaged."""

    def __init__(self, function: Callable[..., Any], stamp: Any) -> None:
        super().__init__(function)
        self._cache_file = _KernelFiles(self._cache_path, self._impl.filename_base, stamp)

    def load_overload(self, *arguments: Any) -> Any:
        """Return the cached code, or discard it and return None if it cannot be read."""
        kept = None
        try:
            kept = super().load_overload(*arguments)
        except Exception:  # a damaged pickle raises anything
            with suppress(OSError):
                self._cache_file.flush()
        if kept is None:
            _tell_once()
        return kept

    def save_overload(self, *arguments: Any) -> None:
        """Store machine code if possible."""
        try:
            super().save_overload(*arguments)
        except OSError as error:
            _warn_once(f"{self._cache_path}: {error.strerror or error}")


class _KernelFiles(IndexDataCacheFile):
    """The files of one function: an index, and one for each kind of arguments and processor.

    Numba counts the latter from 1. Where two processes compile at once, both may then write the same file,
    and the index name it as the code for one processor when it is that for another. Here names say what is
    inside.
    """

    def save(self, key: Any, data: Any) -> None:
        """Keep machine code; of two processes that do so at once, one may have to compile again later."""
        name = f"{self._index_name}.{hashlib.sha256(repr(key).encode()).hexdigest()[:24]}.nbc"
        self._save_data(name, data)
        self._save_index({**self._load_index(), key: name})


@cache
def _tell_once() -> None:
    """Log that this run takes longer because kernels are compiled."""
    logging.getLogger(__name__).info("compiling what this machine has not used yet; later runs start at once")


@cache
def _warn_once(reason: str) -> None:
    warnings.warn(
        f"compiled kernels cannot be kept ({reason}): every process compiles them anew, which takes "
        "seconds each time; set NUMBA_CACHE_DIR to a folder that can be written",
        CacheWarning,
        stacklevel=2,
    )
