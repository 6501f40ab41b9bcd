"""The recorder: what the engine wrote is in the store, whatever ends the recording."""

import multiprocessing
import time
from collections.abc import Iterator
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.refusals import refused

pytest.importorskip("zarr")

from tests.engine.commands import needs_shared_memory, process
from tests.engine.telemetry_cases import LAYOUT, SETTINGS, Engine, as_written, write
from tests.patience import wait_for

from faintspot.engine.telemetry import recorder
from faintspot.engine.telemetry.recorder import Recorder, TelemetryStore
from faintspot.engine.telemetry.ring import TelemetryRing
from faintspot.io import read_telemetry

pytestmark = needs_shared_memory
with_threads = pytest.mark.slow

PATIENCE_S = 60.0


@pytest.fixture
def engine(name: str) -> Iterator[Engine]:
    """Writes frames."""
    with Engine(TelemetryRing.create(name, LAYOUT, settings=SETTINGS, image_slots=200)) as running:
        yield running


def record_on(name: str, path: Path, started: Event) -> None:
    """Record until killed."""
    recorder._FLUSH_S = 0.05
    Recorder(name, path).run(progress=lambda frames: started.set() if frames > 100 else None)


@with_threads
def test_a_number_of_frames(engine: Engine, name: str, tmp_path: Path) -> None:
    path = tmp_path / "night.zarr"
    seen: list[int] = []
    report = Recorder(name, path).run(n_frames=150, progress=seen.append)
    assert (report.frames, report.ended_because) == (150, "frames")
    assert report.dropped + report.dropped_images + report.dropped_changes == 0
    assert seen[-1] == 150
    telemetry = read_telemetry(path)
    assert as_written(vars(telemetry))
    assert list(np.diff(telemetry.frame)) == [1] * 149
    assert report.images == len(telemetry.image_frame) >= 10
    assert np.all(telemetry.raw == telemetry.image_frame[:, None, None])
    assert np.all(telemetry.denoised == telemetry.image_frame[:, None, None, None] + 0.5)
    assert [change["number"] for change in telemetry.changes] == list(range(report.changes))
    attributes = telemetry.attributes
    assert (attributes["complete"], attributes["ended_because"]) == (True, "frames")
    assert type(LAYOUT)(**attributes["layout"]) == LAYOUT
    assert attributes["settings"] == SETTINGS


@with_threads
def test_recorder_ends_after_its_time(
    engine: Engine, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Written in many parts."""
    monkeypatch.setattr(recorder, "_FLUSH_S", 0.02)
    report = Recorder(name, tmp_path / "night.zarr").run(seconds=0.5)
    assert report.ended_because == "seconds"
    telemetry = read_telemetry(tmp_path / "night.zarr")
    assert len(telemetry.frame) == report.frames > 0
    assert as_written(vars(telemetry))


@with_threads
def test_a_slow_disk_loses_only_records(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    append = TelemetryStore.append

    def slow(*arguments: Any) -> None:
        time.sleep(0.2)
        append(*arguments)

    monkeypatch.setattr(TelemetryStore, "append", slow)
    monkeypatch.setattr(recorder, "_FLUSH_S", 0.01)
    with Engine(TelemetryRing.create(name, LAYOUT, records=16), pause_s=2e-4):
        report = Recorder(name, tmp_path / "night.zarr").run(n_frames=100)
    assert report.dropped > 0
    assert report.longest_write_s >= 0.2
    telemetry = read_telemetry(tmp_path / "night.zarr")
    assert as_written(vars(telemetry))
    absent = telemetry.frame[-1] - telemetry.frame[0] + 1 - report.frames
    assert 0 < absent <= report.dropped == telemetry.attributes["dropped_records"]


@with_threads
def test_a_killed_recorder_leaves_a_whole_store(engine: Engine, name: str, tmp_path: Path) -> None:
    spawn = multiprocessing.get_context("spawn")
    started, path = spawn.Event(), tmp_path / "night.zarr"
    with process(record_on, name, path, started):
        assert started.wait(PATIENCE_S)
        wait_for(lambda: len(read_telemetry(path).frame) >= 100)  # it can be read meanwhile
    telemetry = read_telemetry(path)
    assert len(telemetry.frame) >= 100
    assert as_written(vars(telemetry))
    assert not telemetry.attributes["complete"]


def test_a_recording_needs_an_engine_a_new_store_and_limits_above_zero(name: str, tmp_path: Path) -> None:
    with refused("start the engine first"):
        Recorder(name, tmp_path / "night.zarr")
    assert not list(tmp_path.iterdir())
    with TelemetryRing.create(name, LAYOUT) as ring:
        write(ring, 0)
        (tmp_path / "there.zarr").mkdir()
        with refused("already exists"):
            Recorder(name, tmp_path / "there.zarr")
        with refused("cannot be written"):
            Recorder(name, tmp_path / "no" / "folder.zarr")
        for wrong in ({"n_frames": 0}, {"seconds": 0.0}):
            with refused(*wrong):
                Recorder(name, tmp_path / f"{next(iter(wrong))}.zarr").run(**wrong)


def test_methods_that_came_later_are_named(name: str, tmp_path: Path) -> None:
    with TelemetryRing.create(name, LAYOUT, methods=["none", "tv"]) as ring:
        recording = Recorder(name, tmp_path / "night.zarr")
        write(ring, 1)
        ring.write_change(2, 1, {"methods": ["ml", "set"], "first_method": 2, "every": 50}, None)
        recording.run(n_frames=1)
    assert read_telemetry(tmp_path / "night.zarr").attributes["methods"] == ["none", "tv", "ml", "set"]
