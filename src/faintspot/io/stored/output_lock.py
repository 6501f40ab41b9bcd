"""Lock file beside an output, held through the operating system, so that only one program writes it."""

from __future__ import annotations

import contextlib
import errno
import os
import socket
from pathlib import Path

from faintspot.base.errors import InputError

_OWNER_BYTES = 200
_FAR = 1 << 30  # Windows locks bytes: one that nobody reads
# File systems without locks: there only the mark in the output, read before every write, protects it.
_NO_LOCKS = (errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS)


class OutputLock:
    """Lock of an output, held until `release` or the end of the program.

    Parameters
    ----------
    path : Path
        Output; the lock is ".NAME.lock" beside it.

    Raises
    ------
    InputError
        When another program holds the lock; the message names it.
    OSError
        When the lock file cannot be made.
    """

    def __init__(self, path: Path) -> None:
        self._file = path.with_name(f".{path.name}.lock")
        self._descriptor = -1
        while not self._is_held():
            self.release(keep_file=True)  # close the file if its holder removed it meanwhile
            self._descriptor = os.open(self._file, os.O_RDWR | os.O_CREAT, 0o666)
            self._take(path)
        os.ftruncate(self._descriptor, 0)
        os.lseek(self._descriptor, 0, os.SEEK_SET)
        os.write(self._descriptor, f"process {os.getpid()} on {socket.gethostname()}".encode())

    def release(self, *, keep_file: bool = False) -> None:
        """Release the lock; repeated calls do nothing."""
        if self._descriptor >= 0:
            if not keep_file:
                with contextlib.suppress(PermissionError):  # Windows keeps open files
                    self._file.unlink(missing_ok=True)
            os.close(self._descriptor)
            self._descriptor = -1

    def __del__(self) -> None:
        with contextlib.suppress(OSError):
            self.release()

    def _take(self, path: Path) -> None:
        try:
            _lock(self._descriptor)
        except (BlockingIOError, PermissionError):
            os.lseek(self._descriptor, 0, os.SEEK_SET)
            owner = os.read(self._descriptor, _OWNER_BYTES).decode(errors="replace").strip()
            self.release(keep_file=True)
            raise InputError(
                f"{path}: is being written by {owner or 'another program'}; "
                "wait until it has ended or choose another name"
            ) from None
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                self.release(keep_file=True)
                raise

    def _is_held(self) -> bool:
        """Return whether the locked file is still the one at its path."""
        if self._descriptor < 0:
            return False
        try:
            return os.path.samestat(os.fstat(self._descriptor), self._file.stat())
        except FileNotFoundError:
            return False


def _lock(descriptor: int) -> None:
    """Lock a file without waiting.

    Raises
    ------
    BlockingIOError, PermissionError
        When another program holds the lock; the second one on Windows.
    OSError
        When the file system has no locks.
    """
    try:
        import fcntl
    except ImportError:
        import msvcrt

        os.lseek(descriptor, _FAR, os.SEEK_SET)
        msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]
    else:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
