"""Lock file beside an output, held through the operating system, so that only one program writes it."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import socket
from pathlib import Path

from faintspot.base.errors import InputError

_OWNER_BYTES = 200
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
            self._descriptor = os.open(self._file, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
            self._take(path)
        os.ftruncate(self._descriptor, 0)
        os.pwrite(self._descriptor, f"process {os.getpid()} on {socket.gethostname()}".encode(), 0)

    def release(self, *, keep_file: bool = False) -> None:
        """Release the lock; repeated calls do nothing."""
        if self._descriptor >= 0:
            if not keep_file:
                self._file.unlink(missing_ok=True)
            os.close(self._descriptor)
            self._descriptor = -1

    def __del__(self) -> None:
        with contextlib.suppress(OSError):
            self.release()

    def _take(self, path: Path) -> None:
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            owner = os.pread(self._descriptor, _OWNER_BYTES, 0).decode(errors="replace").strip()
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
