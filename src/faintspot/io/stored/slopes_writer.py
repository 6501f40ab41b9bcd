"""Writers of slopes: chunk by chunk into a Zarr store with marks of progress, or from memory."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.closing import Closing
from faintspot.base.errors import InputError
from faintspot.base.files import output_errors, replace_file
from faintspot.base.variables import VARIABLES
from faintspot.io.stored.output_lock import OutputLock
from faintspot.io.stored.slopes_format import RecordingHeader, StoredSlopes, checked_block
from faintspot.io.stored.slopes_zarr import SlopeStore

# A mark waits until the data are on the disk, which takes longer than measuring small blocks.
_MARK_SECONDS = 1.0

Export = Callable[[IO[bytes], StoredSlopes], None]
"""Writes slopes to a stream, as `FileFormat.write`."""


class SlopeWriter(Closing):
    """Writer of slopes, block by block; a `with` statement closes it.

    This class keeps them in memory and writes the output when all frames are there.

    Parameters
    ----------
    path : Path
        Output.
    run : RecordingHeader
        Description of its contents.
    lock : OutputLock, optional
        Lock, which `close` releases.
    export : callable, optional
        Writes the output; None for an output that is complete already.

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
    ) -> None:
        self._path, self._run, self._lock, self._export = path, run, lock, export
        self._is_open = export is not None
        # One attribute, so that an interruption finds both parts of it changed or neither.
        self._state: tuple[int, list[dict[str, NDArray[Any]]]] = (0 if self._is_open else run.n_frames, [])

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
            self._write_chunks()
        except InputError:
            self._state = before
            raise

    def close(self) -> None:
        """Finish the output if it has all frames; otherwise leave it to be resumed, if that is possible."""
        if not self._is_open:
            return
        self._is_open = False
        try:
            self._finish()
        finally:
            if self._lock is not None:
                self._lock.release()

    def _joined(self) -> dict[str, NDArray[Any]]:
        return {name: np.concatenate([block[name] for block in self._waiting]) for name in VARIABLES}

    def _write_chunks(self) -> None:
        """Write waiting frames to the disk, as far as they fill chunks."""

    def _finish(self) -> None:
        run = self._run
        if self.finished() == run.n_frames:
            self._write_output(
                StoredSlopes(self._joined(), run.coordinates, run.attributes, True, run.n_frames)
            )

    def _write_output(self, slopes: StoredSlopes) -> None:
        export = self._export
        if export is not None:
            with output_errors(self._path):
                replace_file(self._path, lambda stream: export(stream, slopes))


class StoreWriter(SlopeWriter):
    """Writer of slopes to a Zarr store, from where it stopped.

    Frames of an incomplete chunk are kept in memory until it is full, or until `close`. Before every write,
    the mark on the disk must be the one that this writer has set; otherwise another program has replaced the
    output. On file systems with locks, the lock prevents that.

    Parameters
    ----------
    path, run, lock
        As for `SlopeWriter`.
    export : callable, optional
        Writes the output from the complete store, which is then removed; by default the store is the output.
    store : SlopeStore
        Store to fill.
    """

    def __init__(
        self, path: Path, run: RecordingHeader, lock: OutputLock, export: Export | None, store: SlopeStore
    ) -> None:
        super().__init__(path, run, lock, export)
        self._is_open = True
        self._store = store
        self._next_mark = 0.0
        with output_errors(path):
            n_stored = store.marked()[1]
            self._marks = {n_stored}
            if n_stored == run.n_frames or n_stored % store.chunk == 0:
                self._state = n_stored, []
            else:  # take the incomplete chunk back into memory, to write the whole chunk again
                start = n_stored - n_stored % store.chunk
                incomplete_chunk = store.read(start, n_stored)
                self._mark(start)
                self._state = start, [incomplete_chunk]

    def _write_chunks(self) -> None:
        n_waiting = self.finished() - self._stored
        is_last = self.finished() == self._run.n_frames
        count = n_waiting if is_last else n_waiting - n_waiting % self._store.chunk
        if count:
            self._write(count)

    def _finish(self) -> None:
        n_waiting = self.finished() - self._stored
        if n_waiting:
            self._write(n_waiting)
        with output_errors(self._path):
            if self._marks != {self._stored}:
                self._check_mark()
                self._mark(self._stored)
            if self._export is not None and self._stored == self._run.n_frames:
                self._check_mark()
                self._write_output(self._store.slopes())
                self._store.remove()

    def _write(self, count: int) -> None:
        """Write the first `count` waiting frames and, if it is due, the mark."""
        joined = self._joined()
        finished = self._stored + count
        with output_errors(self._path):
            self._check_mark()
            self._store.write(self._stored, {name: values[:count] for name, values in joined.items()})
            if finished == self._run.n_frames or time.monotonic() >= self._next_mark:
                self._mark(finished)
        rest = {name: values[count:] for name, values in joined.items()}
        self._state = finished, [rest] if len(rest["x"]) else []

    def _mark(self, finished: int) -> None:
        self._marks.add(finished)  # after an interruption either may be on the disk
        self._store.mark(finished)
        self._marks = {finished}
        self._next_mark = time.monotonic() + _MARK_SECONDS

    def _check_mark(self) -> None:
        try:
            fingerprint, finished = self._store.marked()
            is_ours = fingerprint == self._run.fingerprint and finished in self._marks
        except (OSError, ValueError, KeyError):
            is_ours = False
        if not is_ours:
            raise InputError(
                f"{self._path}: another program has replaced the output of this run, which ends here; "
                "choose another name for it"
            )
