"""Recording of the engine's telemetry to a Zarr store, in a separate process.

The engine is independent of it: a recorder that is too slow, or whose disk is full, loses records and delays
nothing.
"""

import sys
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.checks import number_between
from faintspot.base.errors import InputError, load_package
from faintspot.base.files import output_errors
from faintspot.engine.settings.interleaving import methods_after
from faintspot.engine.telemetry.ring import Ring, TelemetryRing
from faintspot.io.telemetry import ARRAYS, CONTROL, FRAMES, IMAGES, stored_names
from faintspot.io.zarr_store import TELEMETRY, checked_codecs, new_store, replace_attributes

zarr = load_package("zarr")
_CHUNK_NUMBERS, _CHUNK_BYTES = 1 << 16, 1 << 22


class TelemetryStore:
    """Writer of telemetry to a new Zarr store.

    Parameters
    ----------
    path : path
        A directory that does not exist yet.
    record_type, image_type : structured dtype
        Types of the items to append; each field becomes an array of the store.
    attributes : mapping
        JSON values.

    Raises
    ------
    InputError
        When the path exists or cannot be written.
    """

    def __init__(
        self,
        path: str | Path,
        record_type: np.dtype[np.void],
        image_type: np.dtype[np.void],
        attributes: Mapping[str, object],
    ) -> None:
        self.path = Path(path)
        if self.path.exists():
            raise InputError(f"{self.path}: already exists; choose another name")
        self.frames = self.images = 0
        """Numbers of complete frames and images in the store."""
        begin = {"format": TELEMETRY, "version": 1, "changes": [], "complete": False, FRAMES: 0, IMAGES: 0}
        with output_errors(self.path):
            _create(self.path, (record_type, image_type), {**attributes, **begin})
        group: Any = zarr.open_group(str(self.path), mode="r+")
        # Write chunks of zeros, too, so that a missing chunk means lost data.
        with zarr.config.set({"array.write_empty_chunks": True}):
            self._arrays: dict[str, Any] = dict(group.arrays())

    def append(self, records: NDArray[Any], images: NDArray[Any], attributes: Mapping[str, object]) -> None:
        """Append records and images and replace attributes; on return they are in the store.

        Raises
        ------
        InputError
            When the disk is full or not writable; earlier data can still be read.
        """
        with output_errors(self.path):
            for name, values in (*_columns(records), *_columns(images)):
                if not len(values):
                    continue
                array = self._arrays[name]
                start = self.images if ARRAYS[name].dimensions[0] == "image" else self.frames
                array.resize((start + len(values), *values.shape[1:]))
                array[start:] = values
            frames, images_there = self.frames + len(records), self.images + len(images)
            counters = {FRAMES: frames, IMAGES: images_there}
            replace_attributes(self.path, {**attributes, **counters})
        self.frames, self.images = frames, images_there


def _create(path: Path, kinds: tuple[np.dtype[np.void], ...], attributes: Mapping[str, object]) -> None:
    rest = {name: value for name, value in attributes.items() if name != CONTROL}
    with new_store(path, rest) as group:
        group.create_group(CONTROL, attributes={CONTROL: attributes.get(CONTROL)})
        for name, values in (column for kind in kinds for column in _columns(np.empty(0, kind))):
            row = values.shape[1:]
            size = int(np.prod(row))
            is_image = ARRAYS[name].dimensions[0] == "image"
            length = _CHUNK_BYTES // (size * values.itemsize) if is_image else _CHUNK_NUMBERS // size
            group.create_array(
                name,
                shape=(0, *row),
                chunks=(max(1, length), *row),
                dtype=values.dtype,
                compressors=checked_codecs(),
                dimension_names=ARRAYS[name].dimensions,
                attributes={"units": ARRAYS[name].units},
            )


def _columns(items: NDArray[Any]) -> list[tuple[str, NDArray[Any]]]:
    """Return the stored fields of a structured array, by name."""
    return [(name, items[name]) for name in stored_names(items.dtype)]


_POLL_S = 0.01
_FLUSH_S = 1.0
_FLUSH_BYTES = 1 << 26  # amount of buffered data that is written at once
_MOST_RECORDS, _MOST_IMAGES = 1024, 4  # read at once


@dataclass(frozen=True)
class RecordingReport:
    """Result of a recording.

    Attributes
    ----------
    frames, images, changes : int
        Numbers in the store.
    dropped, dropped_images, dropped_changes : int
        Numbers overwritten in shared memory before they were read: reading or writing was too slow.
    seconds : float
    longest_write_s : float
        Longest single write to the disk; nothing is read meanwhile.
    ended_because : str
        "frames", "seconds", "stopped" or "engine ended".
    """

    frames: int
    images: int
    changes: int
    dropped: int
    dropped_images: int
    dropped_changes: int
    seconds: float
    longest_write_s: float
    ended_because: str


@dataclass
class _Reading:
    """Position in a ring, and the items read from there but not yet stored."""

    ring: Ring
    cursor: int
    items: list[NDArray[np.void]] = field(default_factory=list)
    dropped: int = 0

    def read(self, most: int) -> int:
        """Read what is available, up to `most` items; return their number."""
        items, self.cursor, dropped = self.ring.since(self.cursor, most)
        self.dropped += dropped
        if len(items):
            self.items.append(items)
        return len(items)

    def taken(self) -> NDArray[np.void]:
        """Return the items, and forget them."""
        items, self.items = self.items, []
        return np.concatenate([np.empty(0, self.ring.kind), *items])


class Recorder:
    """Recorder of a running engine's telemetry to a new Zarr store.

    Parameters
    ----------
    name : str
        Name of the engine.
    path : path
        Path of the store, a directory that does not exist yet.

    Raises
    ------
    InputError
        When no such engine publishes telemetry, or the store cannot be made.
    """

    def __init__(self, name: str, path: str | Path) -> None:
        self._reader = reader = TelemetryRing.attach(name)
        self._records, self._images = (
            _Reading(ring, ring.written) for ring in (reader.records, reader.images)
        )
        self._change_cursor = self._dropped_changes = (
            0  # from the first one, to know the settings at the start
        )
        self._changes: list[dict[str, object]] = []
        described = ("layout", "settings", "reference", "control")
        attributes = {
            "name": name,
            **{key: reader.description[key] for key in described},
            **self._attributes(),
        }
        self._store = TelemetryStore(path, reader.records.kind, reader.images.kind, attributes)
        self._frames_read = 0
        self._longest_write_s = self._written_at = 0.0

    def run(
        self,
        *,
        n_frames: int | None = None,
        seconds: float | None = None,
        stop: threading.Event | None = None,
        progress: Callable[[int], None] | None = None,
    ) -> RecordingReport:
        """Record until a limit is reached, `stop` is set or the engine ends.

        At the end everything that was read is in the store; while it runs, all but the last second.

        Parameters
        ----------
        n_frames : int, optional
        seconds : float, optional
        stop : event, optional
        progress : function, optional
            Called with the number of frames so far.

        Raises
        ------
        InputError
            When a limit is out of its range, or the disk is full or not writable. Data written before remain
            readable.
        """
        limit = None if n_frames is None else int(number_between("n_frames", n_frames, 1, integer=True))
        duration = np.inf if seconds is None else number_between("seconds", seconds, 0, low_open=True)
        start = self._written_at = time.monotonic()
        ended, gone = "", False
        while not ended:
            something = self._read(sys.maxsize if limit is None else limit)
            if limit is not None and self._frames_read >= limit:
                ended = "frames"
            elif time.monotonic() - start >= duration:
                ended = "seconds"
            elif stop is not None and stop.is_set():
                ended = "stopped"
            elif gone and not something:  # all remaining data has been read
                ended = "engine ended"
            if progress is not None:
                progress(self._frames_read)
            self._write_in_turn()
            if not (something or ended):
                gone = self._reader.stale
                time.sleep(_POLL_S)
        self._images.read(sys.maxsize)  # those of the last frames, of which many may have come at once
        self._write({"complete": True, "ended_because": ended})
        self._reader.close()
        return self._report(time.monotonic() - start, ended)

    def _read(self, limit: int) -> bool:
        """Read what is available, up to `limit` frames in total; return whether there was anything."""
        frames = self._records.read(min(limit - self._frames_read, _MOST_RECORDS))
        self._frames_read += frames
        changes, self._change_cursor, dropped = self._reader.changes_since(self._change_cursor)
        self._changes += changes
        self._dropped_changes += dropped
        return bool(self._images.read(_MOST_IMAGES) + frames)

    def _attributes(self) -> dict[str, Any]:
        """Return attributes of the store that change."""
        return {
            "methods": methods_after(self._reader.description["methods"], self._changes)[0],
            "changes": self._changes,
            "dropped_records": self._records.dropped,
            "dropped_images": self._images.dropped,
            "dropped_changes": self._dropped_changes,
        }

    def _write_in_turn(self) -> None:
        """Write the buffered data if it is time, or if there is much of it."""
        waiting = sum(items.nbytes for items in (*self._records.items, *self._images.items))
        if time.monotonic() - self._written_at > _FLUSH_S or waiting > _FLUSH_BYTES:
            self._write({})
            self._written_at = time.monotonic()

    def _write(self, attributes: Mapping[str, object]) -> None:
        """Write the buffered data."""
        start = time.monotonic()
        records, images = self._records.taken(), self._images.taken()
        try:
            self._store.append(records, images, {**self._attributes(), **attributes})
        except InputError as error:
            raise InputError(f"{error}; {self._store.frames} frames are in the store") from None
        self._longest_write_s = max(self._longest_write_s, time.monotonic() - start)

    def _report(self, seconds: float, ended: str) -> RecordingReport:
        return RecordingReport(
            self._store.frames,
            self._store.images,
            len(self._changes),
            self._records.dropped,
            self._images.dropped,
            self._dropped_changes,
            seconds,
            self._longest_write_s,
            ended,
        )
