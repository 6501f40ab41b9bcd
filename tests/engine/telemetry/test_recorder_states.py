"""Recordings against plain lists: what was read, what is in the store, and what was overwritten before."""

import errno
import shutil
import tempfile
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from queue import SimpleQueue
from typing import Any
from uuid import uuid4

import numpy as np
import pytest
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, precondition, rule

pytest.importorskip("zarr")

import zarr
from tests.engine.commands import needs_shared_memory
from tests.engine.telemetry_cases import LAYOUT, as_written, write, write_images
from tests.patience import LIMIT_S, try_states
from tests.refusals import refused

from faintspot.base.errors import InputError
from faintspot.engine.telemetry import recorder
from faintspot.engine.telemetry.recorder import Recorder
from faintspot.engine.telemetry.ring import CHANGE_SLOTS, TelemetryRing
from faintspot.io import read_telemetry

RECORDS, IMAGES = 8, 7
"""Places in the rings."""
LIMITS = st.none() | st.integers(1, 60)
"""Numbers of frames after which a recording ends."""


class KilledError(BaseException):
    """Ends a recorder without a further step of its own, as a signal would."""


class Disk:
    """A disk that may refuse to extend the next but so many arrays."""

    def __init__(self, resize: Callable[..., None]) -> None:
        self._resize = resize
        self.arrays, self.error = -1, BaseException()

    def resize(self, array: Any, shape: Any) -> None:
        """Extend an array."""
        if self.arrays == 0:
            self.arrays = -1
            raise self.error
        self.arrays -= self.arrays > 0
        self._resize(array, shape)


class Recording(threading.Thread):
    """A recorder in a thread that waits for the test whenever it has read."""

    def __init__(self, name: str, path: Path, n_frames: int | None) -> None:
        super().__init__(daemon=True)
        self.recorder, self.n_frames, self.stop = Recorder(name, path), n_frames, threading.Event()
        self.report: recorder.RecordingReport | None = None
        self.error: BaseException | None = None
        self._ready, self._orders = threading.Semaphore(0), SimpleQueue[str]()

    def run(self) -> None:
        """Record."""
        try:
            self.report = self.recorder.run(n_frames=self.n_frames, stop=self.stop, progress=self._wait)
        except (KilledError, InputError) as error:
            self.error = error
        self._ready.release()

    def _wait(self, frames: int) -> None:
        self._ready.release()
        order = self._orders.get(timeout=LIMIT_S)
        if order == "end":
            raise KilledError
        recorder._FLUSH_S = -1.0 if order == "write" else 1e9

    def go_on(self, order: str) -> None:
        """Let it write or end, and wait until it has read again."""
        self._orders.put(order)
        self.rest()

    def end(self) -> None:
        """End it wherever it is."""
        self._orders.put("end")
        self.join(LIMIT_S)

    def rest(self) -> None:
        """Wait until it waits."""
        assert self._ready.acquire(timeout=LIMIT_S)


@dataclass
class Reading:
    """Items that were written to a ring, and those of them that were read, and stored."""

    written: list[int]
    slots: int
    cursor: int
    items: list[int] = field(default_factory=list)
    stored: int = 0
    dropped: int = 0

    def read(self, most: int) -> int:
        """Read what is there, except the oldest, whose place may be being written to."""
        first = max(self.cursor, len(self.written) - self.slots + 1)
        items = self.written[first : first + most]
        self.dropped += first - self.cursor
        self.cursor = first + len(items)
        self.items += items
        return len(items)


class Recordings(RuleBasedStateMachine):
    """One engine and one recorder at a time."""

    disk: Disk
    recording: Recording | None = None

    @initialize(n_frames=LIMITS)
    def begin(self, n_frames: int | None) -> None:
        self.name, self.folder = f"fs_test_{uuid4().hex[:12]}", Path(tempfile.mkdtemp())
        self.count = 0
        self.engine_begins()
        self.start(n_frames)

    def engine_begins(self) -> None:
        self.ring = TelemetryRing.create(self.name, LAYOUT, records=RECORDS, image_slots=IMAGES)
        self.written: tuple[list[int], list[int], list[int]] = ([], [], [])
        self.is_open = True

    @precondition(lambda self: self.is_open)
    @rule(
        frames=st.integers(1, 12),
        with_images=st.booleans(),
        changes=st.sampled_from([0, 0, 1, 300]),
        writes=st.booleans(),
    )
    def engine_writes(self, frames: int, with_images: bool, changes: int, writes: bool) -> None:
        """Let frames come, and let the recorder read."""
        records, images, numbers = self.written
        for _ in range(frames):
            write(self.ring, self.count)
            records.append(self.count)
            if with_images:
                write_images(self.ring, self.count)
                images.append(self.count)
            self.count += 1
        for _ in range(changes):
            self.ring.write_change(self.count, len(numbers), {"noise_std": 1.0}, None)
            numbers.append(len(numbers))
        if self.recording is not None:
            self.go_on(writes)

    @precondition(lambda self: self.recording is None or len(self.records.items) > 20)
    @rule()
    def engine_restarts(self) -> None:
        """End it; it begins anew when its recorder has ended."""
        if self.is_open:
            self.ring.close()
            self.is_open = False
        elif self.recording is None:
            self.engine_begins()

    @precondition(lambda self: self.recording is None and self.is_open)
    @rule(n_frames=LIMITS)
    def start(self, n_frames: int | None) -> None:
        self.path = self.folder / f"{self.count}_{len(list(self.folder.iterdir()))}.zarr"
        records, images, changes = self.written
        self.records = Reading(records, RECORDS, len(records))
        self.images = Reading(images, IMAGES, len(images))
        self.changes = Reading(changes, CHANGE_SLOTS, 0)
        self.ended, self.is_gone = "", False
        self.recording = Recording(self.name, self.path, n_frames)
        with refused("already exists"):
            Recorder(self.name, self.path)
        self.recording.start()
        self.recording.rest()
        self.read()
        self.check()

    def read(self) -> None:
        """Read as the recorder does, and note whether it ends then."""
        assert self.recording is not None
        n_frames = self.recording.n_frames
        left = 1024 if n_frames is None else n_frames - len(self.records.items)
        something = self.records.read(left) + self.images.read(4) > 0
        self.changes.read(CHANGE_SLOTS)
        if n_frames is not None and len(self.records.items) >= n_frames:
            self.ended = "frames"
        elif self.recording.stop.is_set():
            self.ended = "stopped"
        elif self.is_gone and not something:
            self.ended = "engine ended"
        self.has_read = something

    def store(self) -> None:
        for reading in (self.records, self.images, self.changes):
            reading.stored = len(reading.items)

    @precondition(lambda self: self.recording is not None)
    @rule(writes=st.booleans())
    def go_on(self, writes: bool) -> None:
        assert self.recording is not None
        self.recording.go_on("write" if writes else "read")
        if writes:
            self.store()
        if self.ended:
            self.images.read(IMAGES)
            self.store()
            self.check(complete=True)
            self.check_report()
        else:
            self.is_gone = not self.has_read and not self.is_open
            self.read()
            if writes:
                self.check()

    @precondition(lambda self: self.recording is not None and len(self.records.items) > 20)
    @rule()
    def stop(self) -> None:
        assert self.recording is not None
        self.recording.stop.set()

    @precondition(lambda self: self.recording is not None and len(self.records.items) > 20)
    @rule()
    def kill(self) -> None:
        assert self.recording is not None
        self.recording.go_on("end")
        self.check()
        self.recording = None

    @precondition(lambda self: self.recording is not None and self.records.stored < len(self.records.items))
    @rule(arrays=st.integers(0, 9), is_full=st.booleans())
    def end_amid_a_write(self, arrays: int, is_full: bool) -> None:
        assert self.recording is not None
        full = OSError(errno.ENOSPC, "No space left on device")
        self.disk.arrays, self.disk.error = arrays, full if is_full else KilledError()
        self.recording.go_on("write")
        if is_full:
            with refused("full", f"{self.records.stored} frames"):
                raise self.recording.error or AssertionError
        self.check()
        self.recording = None

    def check(self, *, complete: bool = False) -> None:
        """Read the store, whose last write may have ended amid an array."""
        telemetry = read_telemetry(self.path)
        numbers = [change["number"] for change in telemetry.changes]
        assert telemetry.frame.tolist() == self.records.items[: self.records.stored]
        assert telemetry.image_frame.tolist() == self.images.items[: self.images.stored]
        assert numbers == self.changes.items[: self.changes.stored]
        assert as_written(vars(telemetry))
        assert np.all(telemetry.raw == telemetry.image_frame[:, None, None])
        assert np.all(telemetry.denoised == telemetry.image_frame[:, None, None, None] + 0.5)
        assert telemetry.attributes["complete"] == complete
        assert telemetry.attributes.get("ended_because", "") == (self.ended if complete else "")

    def check_report(self) -> None:
        assert self.recording is not None
        report = self.recording.report
        assert report is not None
        readings = self.records, self.images, self.changes
        assert (report.frames, report.images, report.changes) == tuple(each.stored for each in readings)
        dropped = tuple(each.dropped for each in readings)
        assert (report.dropped, report.dropped_images, report.dropped_changes) == dropped
        assert report.ended_because == self.ended
        attributes = read_telemetry(self.path, images=False).attributes
        assert tuple(attributes[f"dropped_{name}"] for name in ("records", "images", "changes")) == dropped
        self.recording = None

    def teardown(self) -> None:
        if self.recording is not None:
            self.recording.end()
        if hasattr(self, "folder"):
            self.ring.close()
            shutil.rmtree(self.folder)


@needs_shared_memory
@pytest.mark.hypothesis
def test_recordings_are_what_the_engine_wrote(monkeypatch: pytest.MonkeyPatch) -> None:
    disk = Disk(zarr.Array.resize)
    monkeypatch.setattr(zarr.Array, "resize", lambda array, shape: disk.resize(array, shape))
    monkeypatch.setattr(recorder, "_POLL_S", 0.0)
    monkeypatch.setattr(recorder, "_FLUSH_S", 1e9)
    try_states(type("OnDisk", (Recordings,), {"disk": disk}), 6, 20)
