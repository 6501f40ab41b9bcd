"""Lock beside an output, so that only one program writes it."""

from __future__ import annotations

import contextlib
import errno
import os
import socket
from pathlib import Path

from faintspot.base.errors import InputError
from faintspot.io.optional_packages import load_filelock

# On file systems without locks, a file that names its process is the lock.
_NO_LOCKS = (errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS)
_PATIENCE_S = 0.1  # a holder that ends may remove the file that was just opened


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
        filelock = load_filelock()
        self._file = path.with_name(f".{path.name}.lock")
        self._lock = filelock.FileLock(self._file, timeout=_PATIENCE_S, fallback_to_soft=False)
        advice = "wait until it has ended"
        try:
            try:
                self._lock.acquire()
                self._file.write_text(f"{os.getpid()}\n{socket.gethostname()}\n")
            except OSError as error:
                if error.errno not in _NO_LOCKS:
                    raise
                self._file.unlink(missing_ok=True)
                self._file = path.with_name(f".{path.name}.process")
                advice += f" (delete {self._file} if it has)"
                self._lock = filelock.SoftFileLock(self._file, timeout=_PATIENCE_S)
                self._lock.acquire()
        except filelock.Timeout:
            owner = "another program"
            with contextlib.suppress(OSError):  # ended meanwhile, or Windows, which lets nobody read it
                owner = "process " + " on ".join(self._file.read_text(errors="replace").split()[:2])
            raise InputError(
                f"{path}: is being written by {owner}; {advice} or choose another name"
            ) from None

    def release(self) -> None:
        """Release the lock; repeated calls do nothing."""
        if self._lock.is_locked:
            with contextlib.suppress(PermissionError):  # Windows keeps open files
                self._file.unlink(missing_ok=True)
            self._lock.release()

    def __del__(self) -> None:
        with contextlib.suppress(OSError, AttributeError):
            self.release()
