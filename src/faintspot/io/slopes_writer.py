"""The writer of slopes, whatever the format: whole chunks, marks, and nobody else at the same time."""

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
from faintspot.io.output_lock import OutputLock
from faintspot.io.slopes_format import (
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
    """What an output that is there says of itself."""

    fingerprint: str | None
    """None where the format has no place for it."""
    sizes: tuple[int, int]
    complete: bool

    def may_be_continued(self, place: Path, run: RecordingHeader, *, resume: bool, overwrite: bool) -> bool:
        """Say whether `run` goes on with it (True) or replaces it (False).

        Raises
        ------
        InputError
            When it may do neither; `place` is named.
        """
        equal = self.fingerprint == run.fingerprint and self.sizes == run.sizes
        if equal and resume and not (overwrite and self.complete):
            return True
        if not overwrite:
            known = self.fingerprint is not None
            raise exists_already(place) if equal or not known or not resume else belongs_to_another_run(place)
        return False


class Storage(Protocol):
    """Where the slopes of an unfinished run are kept: a folder of flat files, or a Zarr store.

    OSErrors may come out of every method.
    """

    @property
    def place(self) -> Path:
        """The folder, for messages."""

    @property
    def chunk(self) -> int:
        """How many frames are written at once; known when it is open."""

    def begun(self) -> ExistingOutput | None:
        """Return what is there; InputError when that is something else than slopes, or damaged."""

    def remove(self) -> None:
        """Delete what is there."""

    def create(self) -> None:
        """Begin, with no frames; it is never seen half made."""

    def open(self) -> None:
        """Get ready to write into what is there; InputError when it is damaged."""

    def marked(self) -> tuple[str, int]:
        """Return fingerprint and number of frames by the mark that is on the disk."""

    def mark(self, finished: int) -> None:
        """Wait until what was written is on the disk, then say there that so many frames are whole."""

    def read(self, start: int, stop: int) -> dict[str, NDArray[Any]]:
        """Return frames that are stored."""

    def write(self, start: int, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Store frames from `start` on, which is the first of a chunk."""

    def finish(self) -> None:
        """Make the output of it when all frames are marked."""


class BlockWriter(Closing):
    """Writes slopes to a storage that exists, from where it stopped.

    Frames of a chunk that is not full wait in memory until it is, or until `close`. Before every write the
    mark on the disk must be the one that this writer has set: else somebody has replaced the output, which
    the lock prevents where the file system has locks.

    Parameters
    ----------
    path : Path
        The output.
    run : Run
        What it will contain.
    storage : Storage
        Where it is kept until then.
    lock : OutputLock
        Released by `close`.
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
        """Frames that are stored."""
        return self._state[0]

    @property
    def _waiting(self) -> list[dict[str, NDArray[Any]]]:
        """Blocks that follow the stored frames."""
        return self._state[1]

    def finished(self) -> int:
        """Return how many frames it has, stored or waiting: the next block starts there."""
        return self._stored + sum(len(block["x"]) for block in self._waiting)

    def append(self, start: int, block: Mapping[str, NDArray[Any]]) -> None:
        """Add a block of frames; whole chunks go to the disk."""
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
        """Store and mark what waits, and finish the output when it has all frames."""
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
        """Write the first `count` waiting frames, then, when it is time, the mark."""
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
        """Take frames of a chunk that is not full back into memory, so that it is written again whole."""
        start = self._stored - self._stored % self._storage.chunk
        taken_back = self._storage.read(start, self._stored)
        self._mark(start)
        self._state = start, [taken_back]

    def _mark(self, finished: int) -> None:
        self._marks.add(finished)  # interrupted in between, either may be on the disk
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
                f"{self._path}: another program has replaced what this run had written: "
                "this run ends here, choose another name for it"
            )


class FinishedWriter(Closing):
    """Stands for an output that an earlier, equal run has completed: nothing is left to do."""

    def __init__(self, n_frames: int) -> None:
        self._n_frames = n_frames

    def finished(self) -> int:
        """Return the number of frames, all of them."""
        return self._n_frames

    def append(self, start: int, block: Mapping[str, NDArray[Any]]) -> None:
        """Refuse: the output is complete."""
        raise InputError(f"slopes: the output is complete with {self._n_frames} frames, got frame {start}")

    def close(self) -> None:
        """Nothing is open."""
