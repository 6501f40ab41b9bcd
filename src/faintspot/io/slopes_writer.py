"""Writer of slopes: chunk by chunk into a Zarr store with marks of progress, or from memory.

`to_zarr` of xarray appends without waiting for the disk: a kill could lose frames that the store states.
"""

import contextlib
import errno
import os
import socket
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError, load_package
from faintspot.base.files import Closing, output_errors, replace_file
from faintspot.base.flags import VARIABLES
from faintspot.io.file_format import RecordingHeader, StoredSlopes, checked_block
from faintspot.io.formats.zarr_files import SlopeStore, remove_store

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
        filelock = load_package("filelock")
        self._file = path.with_name(f".{path.name}.lock")
        self._lock = filelock.FileLock(self._file, timeout=_PATIENCE_S, fallback_to_soft=False)
        advice = "wait until it has ended"
        try:
            try:
                self._lock.acquire()
                with contextlib.suppress(PermissionError):  # Windows lets nobody write to a locked file
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


# A mark waits until the data are on the disk, which takes longer than measuring small blocks.
_MARK_SECONDS = 1.0

Export = Callable[[IO[bytes], StoredSlopes], None]
"""Writes slopes to a stream, as `FileFormat.write`."""


class SlopeWriter(Closing):
    """Writer of slopes, block by block, from where its store stopped; a `with` statement closes it.

    Frames of an incomplete chunk are kept in memory until it is full, or until `close`; without a store, all.

    Parameters
    ----------
    path : Path
        Output.
    run : RecordingHeader
        Description of its contents.
    lock : OutputLock, optional
        Lock, which `close` releases.
    export : callable, optional
        Writes the output when all frames are there; the store is then removed. By default, the store is the
        output.
    store : SlopeStore, optional
        Store to fill. Without `export` and `store`, the output is complete already.

    Examples
    --------
    >>> import numpy as np
    >>> from faintspot.io import create_writer
    >>> names = ("x", "y", "flux", "valid", "flags", "iterations", "bad_pixels")
    >>> run = {"n_frames": 5, "n_subapertures": 3, "attributes": {"fingerprint": "mine"}, "coordinates": {}}
    >>> with create_writer("slopes.npz", **run) as writer:
    ...     writer.append(0, {name: np.zeros((2, 3)) for name in names})
    ...     print(writer.finished(), "of 5 frames")
    2 of 5 frames
    """

    def __init__(
        self,
        path: Path,
        run: RecordingHeader,
        lock: OutputLock | None = None,
        export: Export | None = None,
        store: SlopeStore | None = None,
    ) -> None:
        self._path, self._run, self._lock, self._export, self._store = path, run, lock, export, store
        self._is_open = export is not None or store is not None
        self._next_mark = 0.0  # an incomplete chunk that is written again has a new mark at once
        # One attribute, so that an interruption finds both parts of it changed or neither.
        self._state: tuple[int, list[dict[str, NDArray[Any]]]] = (0 if self._is_open else run.n_frames, [])
        if store is not None:
            with output_errors(path):
                self._state = store.resume()

    @property
    def _stored(self) -> int:
        """Number of stored frames."""
        return self._state[0]

    @property
    def _waiting(self) -> list[dict[str, NDArray[Any]]]:
        """Blocks that follow the stored frames."""
        return self._state[1]

    def finished(self) -> int:
        """Return the number of frames, stored or waiting: the next block starts there."""
        return self._stored + sum(len(block["x"]) for block in self._waiting)

    def append(self, start: int, block: Mapping[str, NDArray[np.generic]]) -> None:
        """Add frames `start`, `start` + 1 ...: every variable of `VARIABLES`, (n, n_subapertures).

        Variables with a default may be omitted.

        Raises
        ------
        InputError
            When the block does not fit, or the disk is full or not writable.
        """
        if not self._is_open:
            raise InputError(f"{self._path}: complete or closed, expected no more frames, got frame {start}")
        variables = checked_block(self._run, self.finished(), start, block)
        before = self._state
        copied = {name: values.copy() for name, values in variables.items()}
        self._state = (self._stored, [*self._waiting, copied])
        try:
            self._store_waiting()
        except InputError:
            self._state = before
            raise

    def close(self) -> None:
        """Finish the output if it has all frames; otherwise leave it to be resumed, if that is possible."""
        if not self._is_open:
            return
        self._is_open = False
        try:
            self._store_waiting(is_last=True)
            with output_errors(self._path):
                self._finish()
        finally:
            if self._lock is not None:
                self._lock.release()

    def _finish(self) -> None:
        store, export, run = self._store, self._export, self._run
        if store is not None and store.marked != self._stored:
            store.mark(self._stored)
        if export is None or self.finished() < run.n_frames:
            return
        variables = self._joined() if store is None else store.variables()
        slopes = StoredSlopes(variables, run.coordinates, run.attributes, True, run.n_frames)
        replace_file(self._path, lambda stream: export(stream, slopes))
        if store is not None:
            remove_store(store.path)

    def _joined(self) -> dict[str, NDArray[Any]]:
        return {name: np.concatenate([block[name] for block in self._waiting]) for name in VARIABLES}

    def _store_waiting(self, *, is_last: bool = False) -> None:
        """Store waiting frames, as far as they fill chunks or are the last; and, if it is due, the mark."""
        store, finished = self._store, self.finished()
        if store is None or not self._waiting:
            return
        if not is_last and finished < self._run.n_frames:
            finished -= (finished - self._stored) % store.chunk
        count = finished - self._stored
        if not count:
            return
        joined = self._joined()
        with output_errors(self._path):
            store.write(self._stored, {name: values[:count] for name, values in joined.items()})
            if finished == self._run.n_frames or time.monotonic() >= self._next_mark:
                store.mark(finished)
                self._next_mark = time.monotonic() + _MARK_SECONDS
        rest = {name: values[count:] for name, values in joined.items()}
        self._state = finished, [rest] if len(rest["x"]) else []
