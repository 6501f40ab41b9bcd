"""The recorder: what the engine wrote is in the store, whatever ends the recording."""

import multiprocessing
import resource
from collections.abc import Iterator
from multiprocessing.synchronize import Event
from pathlib import Path

import pytest
from tests.refusals import refused

pytest.importorskip("zarr")

from tests.engine.commands import needs_shared_memory, process, start
from tests.engine.telemetry_cases import LAYOUT, SETTINGS, Engine, as_written, write
from tests.patience import wait_for

from faintspot.engine.telemetry import recorder
from faintspot.engine.telemetry.recorder import Recorder
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
def test_no_space_is_one_line(engine: Engine, name: str, tmp_path: Path) -> None:
    """Files may not be larger than 60 kB: what was written before is whole."""
    code = "from faintspot.cli import main; main()"
    path = tmp_path / "night.zarr"
    limit = lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, 60_000))  # noqa: E731
    process = start(code, "realtime", "record", str(path), "--name", name, preexec_fn=limit)
    _, said = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 2, said
    telemetry = read_telemetry(path)
    assert len(telemetry.frame) > 0
    assert as_written(vars(telemetry))
    assert "cannot be written: File too large" in said
    assert said.rstrip().endswith(f"; {len(telemetry.frame)} frames are in the store")
    assert said.count("error") == 1


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


def test_what_a_recording_says_of_its_engine(name: str, tmp_path: Path) -> None:
    with TelemetryRing.create(name, LAYOUT, settings=SETTINGS, methods=["none", "tv"]) as ring:
        recording = Recorder(name, tmp_path / "night.zarr")
        write(ring, 1)
        ring.write_change(2, 1, {"methods": ["ml", "set"], "first_method": 2, "every": 50}, None)
        recording.run(n_frames=1)
        later = Recorder(name, tmp_path / "later.zarr")
        assert later.run(seconds=1e-3).ended_because == "seconds"
    attributes = read_telemetry(tmp_path / "night.zarr").attributes
    assert attributes["methods"] == ["none", "tv", "ml", "set"]
    assert attributes["settings"] == SETTINGS
    assert type(LAYOUT)(**attributes["layout"]) == LAYOUT
