"""Writer of slopes for all formats: stores whole chunks, marks progress, and locks the output."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from faintspot.base.closing import Closing
from faintspot.base.errors import InputError
from faintspot.base.files import output_errors
from faintspot.io.stored.output_lock import OutputLock
from faintspot.io.stored.slopes_format import (
    VARIABLES,
    RecordingHeader,
    belongs_to_another_run,
    checked_block,
    exists_already,
)

# A mark waits until the data are on the disk, which takes longer than measuring small blocks.
_MARK_SECONDS = 1.0


@dataclass(frozen=True)
class ExistingOutput:
    """Description of an existing output."""

    fingerprint: str | None
    """Fingerprint of the run; None if the format does not store it."""
    sizes: tuple[int, int]
    complete: bool

    def may_be_continued(self, place: Path, run: RecordingHeader, *, resume: bool, overwrite: bool) -> bool:
        """Return whether `run` continues the output (True) or replaces it (False).

        Raises
        ------
        InputError
            When it may do neither; the message names `place`.
        """
        equal = self.fingerprint == run.fingerprint and self.sizes == run.sizes
        if equal and resume and not (overwrite and self.complete):
            return True
        if not overwrite:
            known = self.fingerprint is not None
            raise exists_already(place) if equal or not known or not resume else belongs_to_another_run(place)
        return False


class Storage(Protocol):
    """Storage of the slopes of an unfinished run: a folder of flat files, or a Zarr store.

    Every method may raise OSError.
    """

    @property
    def place(self) -> Path:
        """Folder, for messages."""

    @property
    def chunk(self) -> int:
        """Number of frames written at once; known after opening."""

    def begun(self) -> ExistingOutput | None:
        """Return the existing output; raise InputError if it is not slopes, or damaged."""

    def remove(self) -> None:
        """Delete the existing output."""

    def create(self) -> None:
        """Create an empty storage; it never appears incomplete."""

    def open(self) -> None:
        """Prepare to write to an existing storage; raise InputError if it is damaged."""

    def marked(self) -> tuple[str, int]:
        """Return the fingerprint and the number of frames from the mark on the disk."""

    def mark(self, finished: int) -> None:
        """Wait until the data are on the disk, then write the number of complete frames."""

    def read(self, start: int, stop: int) -> dict[str, NDArray[Any]]:
        """Return stored frames."""

    def write(self, start: int, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Store frames from `start` on, which is the first of a chunk."""

    def finish(self) -> None:
        """Make the final output when all frames are marked."""


class BlockWriter(Closing):
    """Writer of slopes to an existing storage, from where it stopped.

    Frames of an incomplete chunk are kept in memory until it is full, or until `close`. Before every write,
    the mark on the disk must be the one that this writer has set; otherwise another program has replaced the
    output. On file systems with locks, the lock prevents that.

    Parameters
    ----------
    path : Path
        Output.
    run : Run
        Description of its contents.
    storage : Storage
        Storage until the output is complete.
    lock : OutputLock
        Lock, which `close` releases.
    """

    def __init__(self, path: Path, run: RecordingHeader, storage: Storage, lock: OutputLock) -> None:
        self._path = path
        self._run = run
        self._storage = storage
        self._lock = lock
        self._is_open = True
        self._next_mark = 0.0
        with output_errors(path):
            storage.open()
            # One attribute, so that an interruption finds both parts of it changed or neither.
            self._state: tuple[int, list[dict[str, NDArray[Any]]]] = (storage.marked()[1], [])
            self._marks = {self._stored}
            if self._stored < run.n_frames and self._stored % storage.chunk:
                self._take_back_last_chunk()

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

    def append(self, start: int, block: Mapping[str, NDArray[Any]]) -> None:
        """Add a block of frames; write complete chunks to the disk."""
        if not self._is_open:
            raise InputError(f"{self._path}: expected no more slopes after close(), got frame {start}")
        arrays = checked_block(self._run, self.finished(), start, block)
        before = self._state
        self._state = (self._stored, [*self._waiting, {name: array.copy() for name, array in arrays.items()}])
        try:
            waiting = self.finished() - self._stored
            if self.finished() == self._run.n_frames:
                self._store(waiting)
            elif waiting >= self._storage.chunk:
                self._store(waiting - waiting % self._storage.chunk)
        except InputError:
            self._state = before
            raise

    def close(self) -> None:
        """Store and mark waiting frames, and finish the output if it has all frames."""
        if not self._is_open:
            return
        self._is_open = False
        try:
            waiting = self.finished() - self._stored
            if waiting:
                self._store(waiting)
            with output_errors(self._path):
                if self._marks != {self._stored}:
                    self._check_mark()
                    self._mark(self._stored)
                if self._stored == self._run.n_frames:
                    self._check_mark()
                    self._storage.finish()
        finally:
            self._lock.release()

    def _store(self, count: int) -> None:
        """Write the first `count` waiting frames and, if it is due, the mark."""
        joined = {name: np.concatenate([block[name] for block in self._waiting]) for name in VARIABLES}
        finished = self._stored + count
        with output_errors(self._path):
            self._check_mark()
            self._storage.write(self._stored, {name: array[:count] for name, array in joined.items()})
            if finished == self._run.n_frames or time.monotonic() >= self._next_mark:
                self._mark(finished)
        rest = {name: array[count:] for name, array in joined.items()}
        self._state = finished, [rest] if len(rest["x"]) else []

    def _take_back_last_chunk(self) -> None:
        """Read frames of an incomplete chunk back into memory, to write the whole chunk again."""
        start = self._stored - self._stored % self._storage.chunk
        taken_back = self._storage.read(start, self._stored)
        self._mark(start)
        self._state = start, [taken_back]

    def _mark(self, finished: int) -> None:
        self._marks.add(finished)  # after an interruption either may be on the disk
        self._storage.mark(finished)
        self._marks = {finished}
        self._next_mark = time.monotonic() + _MARK_SECONDS

    def _check_mark(self) -> None:
        try:
            fingerprint, finished = self._storage.marked()
            ours = fingerprint == self._run.fingerprint and finished in self._marks
        except (OSError, ValueError, KeyError):
            ours = False
        if not ours:
            raise InputError(
                f"{self._path}: another program has replaced the output of this run, which ends here; "
                "choose another name for it"
            )


class FinishedWriter(Closing):
    """Writer for an output that an equal run has completed: nothing is left to do."""

    def __init__(self, n_frames: int) -> None:
        self._n_frames = n_frames

    def finished(self) -> int:
        """Return the number of frames, all of them."""
        return self._n_frames

    def append(self, start: int, block: Mapping[str, NDArray[Any]]) -> None:
        """Raise InputError: the output is complete."""
        raise InputError(f"slopes: expected no more frames, {self._n_frames} are complete, got frame {start}")

    def close(self) -> None:
        """Do nothing: nothing is open."""
