"""Data of a running engine, read from shared memory."""

import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.checks import number_between
from faintspot.base.errors import InputError
from faintspot.engine.page.page_state import Batch, Floats, Picture
from faintspot.engine.requests import Handler
from faintspot.engine.streams.stream import Follower
from faintspot.engine.telemetry.ring import TelemetryRing, image_type, record_type
from faintspot.engine.telescope import TRUTH
from faintspot.io.telemetry import StoredTelemetry, stored_names
from faintspot.slopes.sensor.layout import Layout

_TRUTH_FIELDS = tuple(TRUTH.index(name) for name in ("strehl", "rms_nm", "time_s"))


class EngineSource:
    """Telemetry of an engine, with the truth and commands if available.

    It waits for the engine to start, and to restart.

    Parameters
    ----------
    name : str
        Name of the engine.

    Raises
    ------
    MissingExtraError
        When pyshmem is not installed.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.layout: Layout | None = None
        self.methods: list[str] = []
        self._reader: TelemetryRing | None = None
        self._truth, self._commands = Follower(f"{name}_truth"), Follower(f"{name}_commands")
        self._cursors = [0, 0, 0]  # records, images, changes
        self._camera_hz: float | None = None

    def read(self) -> Batch | None:
        """Return the data since the last call; None while there is no engine."""
        anew = self._reader is None and self._attached()
        reader = self._reader
        if reader is None:
            return None
        truth = self._newest_truth()
        # Images first: each image's record was written before it, so it is among these records or older ones.
        images, self._cursors[1], _ = reader.images.since(max(self._cursors[1], reader.images.written - 1))
        records, self._cursors[0], missed = reader.records.since(self._cursors[0])
        changes, self._cursors[2], _ = reader.changes_since(self._cursors[2])
        picture = None
        if len(images):
            newest = images[-1]
            picture = Picture(int(newest["image_frame"]), newest["raw"], newest["denoised"])
        if not len(records) and reader.stale:  # all of it has been read
            reader.close()
            self._reader = None
        commands = self._commands.newest()
        return Batch(
            records,
            missed,
            picture,
            truth=truth,
            commands=None if commands is None else commands.values.astype(np.float64),
            changes=changes,
            anew=anew,
        )

    def state(self) -> dict[str, Any]:
        """Return the engine's name, whether it is running, and the frame rate of a simulated camera."""
        is_running = self._reader is not None
        return {"kind": "engine", "name": self.name, "there": is_running, "camera_hz": self._camera_hz}

    def close(self) -> None:
        """Close the shared memory."""
        self._truth.close()
        self._commands.close()
        if self._reader is not None:
            self._reader.close()
            self._reader = None

    def _attached(self) -> bool:
        """Look for the engine's telemetry; return whether it is available."""
        try:
            reader = TelemetryRing.attach(self.name)
        except InputError:
            return False
        if reader.stale:
            reader.close()
            return False
        self._reader, self.layout = reader, reader.layout
        self.methods = reader.description["methods"]
        self._cursors = [reader.records.written, max(0, reader.images.written - 1), 0]
        return True

    def _newest_truth(self) -> tuple[int, float, float] | None:
        truth = self._truth.newest()
        if truth is None or len(truth.values) != len(TRUTH):
            return None
        strehl, rms_nm, time_s = truth.values[list(_TRUTH_FIELDS)]
        self._camera_hz = round((truth.number + 0.5) / time_s, 3) if time_s > 0 else None
        return (truth.number, float(strehl), float(rms_nm)) if np.isfinite([strehl, rms_nm]).all() else None


_MOST_RECORDS = 4096  # per read; faster playback shows the newest
_FASTEST = 100.0


class RecordingSource:
    """Telemetry from a store, played in real time; all clients see the same moment.

    Parameters
    ----------
    path : path
        Store written by `faintspot realtime record`.

    Raises
    ------
    InputError
        When it is not a telemetry store, damaged, or without frames.
    """

    def __init__(self, path: str | Path) -> None:
        self._store = store = StoredTelemetry(path)
        if not store.frames:
            raise InputError(f"{path}: expected a recording with frames, got none")
        self.name = store.path.name
        try:
            self.layout: Layout | None = Layout(**store.attributes["layout"])
            self.methods = [str(method) for method in store.attributes.get("methods", [])]
            changed = [(int(change["frame"]), dict(change["changes"]))[0] for change in store.changes]
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise InputError(f"{path}: the store is damaged ({type(error).__name__}: {error})") from None
        self._type = record_type(len(self.layout))
        store.check_shapes(
            [self._type, image_type(self.layout.frame_shape, len(self.layout), self.layout.window)]
        )
        times = store.read("last_row_time_ns", 0, store.frames)
        self._times_s = np.maximum.accumulate((times - times[0]) / 1e9)
        frames = store.read("frame", 0, store.frames)
        self._pictures = indices_of(store.read("image_frame", 0, store.images), frames)
        self._change_indices = np.searchsorted(frames, changed)
        self._n_sent = 0
        self._lock = threading.Lock()  # for the state below: read by one thread, changed by others
        self._playing, self._speed, self._position_s = True, 1.0, 0.0
        self._looked_s = time.monotonic()
        self._next, self._shown_picture, self._moved = 0, -1, True
        self._block: tuple[int, NDArray[np.void]] = (-1, np.empty(0, self._type))

    @property
    def length_s(self) -> float:
        """Time from the first frame to the last [s]."""
        return float(self._times_s[-1])

    def read(self) -> Batch | None:
        """Return the frames of the time that passed since the last call."""
        with self._lock:
            now, moved = time.monotonic(), self._moved
            self._moved = False
            if self._playing:
                self._position_s = min(self._position_s + self._speed * (now - self._looked_s), self.length_s)
                self._playing = self._position_s < self.length_s
            self._looked_s = now
            end = int(np.searchsorted(self._times_s, self._position_s, side="right"))
            if moved:
                self._next, self._shown_picture = max(0, end - 1), -1
            first, self._next = max(self._next, end - _MOST_RECORDS), end
        return Batch(
            self._records(first, end),
            picture=self._picture(end),
            commands=self._commands(end) if end > first else None,
            changes=self._changes(end, moved),
            anew=moved,
        )

    def state(self) -> dict[str, Any]:
        """Return the moment that is shown, and whether it is playing."""
        with self._lock:
            return {
                "kind": "recording",
                "name": self.name,
                "there": True,
                "position_s": round(self._position_s, 2),
                "length_s": self.length_s,
                "playing": self._playing,
                "speed": self._speed,
                "settings": str(self._store.attributes.get("settings", "")),
            }

    # Requests of clients -------------------------------------------------------------------------------

    def functions(self) -> Mapping[str, Handler]:
        """Return the functions of the requests, by name."""
        return {"play": self._play}

    def _play(self, request: Mapping[str, object]) -> Mapping[str, object]:
        """Move to "position_s", play or pause ("playing"), and set the "speed"."""
        position, speed, playing = (request.get(name) for name in ("position_s", "speed", "playing"))
        if position is not None:
            position = number_between("position_s", position, 0)
        if speed is not None:
            speed = number_between("speed", speed, 0.01, _FASTEST)
        if playing is not None and not isinstance(playing, bool):
            raise InputError(f"playing = {playing!r:.40}: expected true or false")
        with self._lock:
            if position is None and playing and not self._playing and self._position_s >= self.length_s:
                position = 0.0  # restart at the beginning
            if position is not None:
                self._position_s, self._moved = min(position, self.length_s), True
            if speed is not None:
                self._speed = speed
            if playing is not None:
                self._playing = playing
        return {}

    # Reading ------------------------------------------------------------------------------------------------

    def _records(self, first: int, end: int) -> NDArray[np.void]:
        """Return the records of frames `first` to `end`, in the order of the store."""
        together = self._store.frames_together
        parts = [np.empty(0, self._type)]
        for number in range(first // together, -(-end // together)):
            begin = number * together
            parts.append(self._of_block(number, together)[max(first - begin, 0) : end - begin])
        return np.concatenate(parts)

    def _of_block(self, number: int, together: int) -> NDArray[np.void]:
        """Return the records of one chunk of the store; the last chunk is cached."""
        if self._block[0] != number:
            start, stop = number * together, min((number + 1) * together, self._store.frames)
            records = np.zeros(stop - start, self._type)
            for name in stored_names(self._type):
                records[name] = self._store.read(name, start, stop)
            self._block = number, records
        return self._block[1]

    def _picture(self, end: int) -> Picture | None:
        """Return the newest picture if it has not been shown yet."""
        newest = int(np.searchsorted(self._pictures, end)) - 1
        if newest < 0 or newest == self._shown_picture:
            return None
        self._shown_picture = newest
        store = self._store
        frame, raw, denoised = (
            store.read(name, newest, newest + 1)[0] for name in ("image_frame", "raw", "denoised")
        )
        return Picture(int(frame), raw, denoised)

    def _commands(self, end: int) -> Floats | None:
        """Return the commands of the newest frame, if they were recorded."""
        if "commands" not in self._store:
            return None
        return np.asarray(self._store.read("commands", end - 1, end)[0], np.float64)

    def _changes(self, end: int, anew: bool) -> list[dict[str, object]]:
        """Return the changes of settings up to this moment that have not been sent yet."""
        sent = 0 if anew else self._n_sent
        self._n_sent = int(np.searchsorted(self._change_indices, end))
        return self._store.changes[sent : self._n_sent]


def indices_of(sought: NDArray[np.int64], frames: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the index of each wanted frame among the frames, both in order of arrival.

    A camera may restart its frame numbers, so each number is searched for after the previous match. A missing
    frame gets the index before it.
    """
    indices = np.zeros(len(sought), np.int64)
    candidates: dict[int, list[int]] = {}
    for row in np.flatnonzero(np.isin(frames, sought)):
        candidates.setdefault(int(frames[row]), []).append(int(row))
    before = 0
    for index, frame in enumerate(sought):
        before = next((match for match in candidates.get(int(frame), []) if match >= before), before)
        indices[index] = before
    return indices
