"""Creation and opening of pyshmem streams, safe against other users.

pyshmem has one lock file for every stream, in $PYSHMEM_LOCK_DIR or a per-user folder in the temporary
directory, and waits for a lock without limit. All programs that share a stream must use the same folder,
including programs that do not use faintspot. So its place is kept, but it must belong to the user and be
closed to others.
"""

import ctypes.util
import errno
import fcntl
import hashlib
import math
import os
import platform
import stat
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from faintspot.base.errors import InputError, MissingExtraError
from faintspot.engine.processes.segment import FOLDER, new_memory, process_age_s

LOCK_LIMIT_S = 1.0
_LOOK_S = 0.01
_CLOCKS_AGREE_S = 0.1
_BESIDE_BYTES = 1 << 16  # pyshmem's overhead per stream
_PARTS = ("", "_meta", "_gpu")


def pyshmem_module(purpose: str) -> Any:
    """Import and return pyshmem.

    Raises
    ------
    MissingExtraError
        When it is not installed; the message names `purpose`.
    InputError
        When it cannot order its memory accesses on this machine.
    """
    try:
        import pyshmem
    except ImportError:
        raise MissingExtraError("pyshmem", "realtime", purpose) from None
    if not _keeps_order(platform.machine().lower()):
        raise InputError(
            f"pyshmem: expected GCC's libatomic on {platform.machine()}, found none; install libatomic1"
        )
    return pyshmem


@cache
def _keeps_order(machine: str) -> bool:
    """Return whether pyshmem's readers work without locks, which publishers hold permanently."""
    return machine in ("x86_64", "amd64") or ctypes.util.find_library("atomic") is not None


def lock_file(name: str) -> Path:
    """Return the lock file of a stream, in a private folder that is made if necessary.

    Raises
    ------
    InputError
        When the folder is not private, or the path of the lock file is something else.
    """
    folder = _private_lock_folder()
    path = folder / f"{_base(name)}.lock"
    if os.path.lexists(path) and not stat.S_ISREG(os.lstat(path).st_mode):
        raise InputError(f"{path}: expected a lock file or nothing, got another kind of file; remove it")
    return path


def create_stream(
    name: str, shape: tuple[int, ...], dtype: DTypeLike = np.float32, *, patience_s: float = LOCK_LIMIT_S
) -> Any:
    """Create a stream; replace one that is damaged or whose maker has died.

    Parameters
    ----------
    name, shape, dtype
    patience_s : float
        Time to wait for another process that holds the name's lock.

    Raises
    ------
    MissingExtraError
        When pyshmem is not installed.
    InputError
        When a living process publishes under that name, another user has taken it, the lock folder is not
        private, or shared memory is short.
    """
    pyshmem = pyshmem_module("publishing slopes in shared memory")
    try:
        _check_free(name, patience_s)
        for path in _left_behind(pyshmem, name):
            path.unlink()  # pyshmem does not remove damaged files
        _reserve(name, math.prod(shape) * np.dtype(dtype).itemsize + _BESIDE_BYTES)
        return pyshmem.create(name, shape=shape, dtype=dtype)
    except InputError:
        raise
    except (OSError, ValueError, RuntimeError) as error:
        text = getattr(error, "strerror", None) or " ".join(str(error).split())
        raise InputError(f"{name}: the stream cannot be created ({text})") from None


def generation(name: str) -> int | None:
    """Return a number that changes when a stream is recreated (takes some us); None if it does not exist."""
    try:
        return os.stat(FOLDER / _base(name)).st_ino
    except OSError:
        return None


@contextmanager
def held(*streams: Any) -> Iterator[None]:
    """Hold the streams' write locks while publishing; readers do not wait for them.

    Taking a lock for each frame would take three times as long as publishing.

    Raises
    ------
    InputError
        When another process holds one.
    """
    with ExitStack() as stack:
        for stream in streams:
            try:
                stack.enter_context(stream.locked(timeout=LOCK_LIMIT_S))
            except TimeoutError:
                path = lock_file(stream.name)
                raise InputError(f"{stream.name}: another process holds {path}; end it") from None
        yield


def _base(name: str) -> str:
    """Return pyshmem's name for a stream's files."""
    return f"ps_{hashlib.sha1(name.encode(), usedforsecurity=False).hexdigest()[:14]}"


def _private_lock_folder() -> Path:
    """Return the folder of pyshmem's locks, after checking that it is private."""
    chosen = os.environ.get("PYSHMEM_LOCK_DIR")
    folder = Path(chosen or Path(tempfile.gettempdir()) / f"pyshmem-locks-{os.getuid()}")
    advice = "set PYSHMEM_LOCK_DIR to one, the same for all programs that share streams"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    except OSError as error:
        raise InputError(
            f"{folder}: no folder for the locks of streams ({error.strerror}); {advice}"
        ) from None
    try:
        status = os.fstat(descriptor)
        if status.st_uid == os.geteuid() and status.st_mode & 0o077 and not chosen:
            os.fchmod(descriptor, 0o700)  # pyshmem's mode would let any user hold the locks
            status = os.fstat(descriptor)
        if status.st_uid != os.geteuid() or status.st_mode & 0o077:
            raise InputError(
                f"{folder}: expected a folder of your own that nobody else may enter (mode 0700); {advice}"
            )
    finally:
        os.close(descriptor)
    return folder


def _check_free(name: str, patience_s: float) -> None:
    """Refuse a name whose lock a living publisher holds, or that another user has taken."""
    path = lock_file(name)
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    try:
        if not _lock_within(descriptor, patience_s):
            raise InputError(
                f"{name}: a living process publishes under this name (it holds {path}); stop it or choose "
                "another --name"
            )
    finally:
        os.close(descriptor)
    for part in _PARTS:
        segment = FOLDER / f"{_base(name)}{part}"
        if os.path.lexists(segment) and os.lstat(segment).st_uid != os.geteuid():
            raise InputError(f"{name}: {segment} belongs to another user; remove it or choose another --name")


def _lock_within(descriptor: int, limit_s: float) -> bool:
    """Lock an open file for this descriptor; return whether that succeeded in time."""
    end = time.monotonic() + limit_s
    while True:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
        except BlockingIOError:
            if time.monotonic() >= end:
                return False
        time.sleep(_LOOK_S)


def _left_behind(pyshmem: Any, name: str) -> list[Path]:
    """Return a stream's files if no process owns them; raise InputError if its maker is alive."""
    parts = [path for part in _PARTS if os.path.lexists(path := FOLDER / f"{_base(name)}{part}")]
    if not parts:
        return []
    made_s = min(os.lstat(path).st_mtime for path in parts)
    try:
        stream = pyshmem.open(name)
    except (OSError, ValueError):  # damaged or incomplete
        return parts
    pid = stream.creator_pid
    stream.close()
    # A process younger than the stream has merely reused its maker's id, e.g. after a container restart.
    if process_age_s(pid) >= time.time() - made_s - _CLOCKS_AGREE_S:
        raise InputError(
            f"{name}: a living process publishes under this name (pid {pid}); stop it or choose another "
            "--name"
        )
    return parts


def _reserve(name: str, size: int) -> None:
    """Refuse a size above the free shared memory: writing to full shared memory kills the process."""
    try:
        with new_memory(FOLDER / _base(name), size):
            return
    except OSError as error:
        if error.errno != errno.ENOSPC:
            raise
        raise InputError(
            f"{name}: the stream cannot be created: its {size} bytes exceed the free space in {FOLDER}"
        ) from None
