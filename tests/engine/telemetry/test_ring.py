"""The telemetry ring: records come whole and in order, and what a slow reader loses is counted."""

import multiprocessing
import time
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.engine.commands import is_stale, needs_shared_memory, process
from tests.engine.telemetry_cases import LAYOUT, SETTINGS, N, as_written, slopes_of, write, write_images
from tests.patience import LIMIT_S
from tests.refusals import refused

from faintspot.engine.frames.pixel_ring import PixelRing
from faintspot.engine.processes.segment import FOLDER
from faintspot.engine.telemetry.ring import TelemetryRing
from faintspot.slopes.sensor.layout import Layout

pytestmark = [needs_shared_memory, pytest.mark.slow]


def write_on(name: str, ready: Event, enough: Event) -> None:
    """Write frames as fast as possible until told."""
    with TelemetryRing.create(name, LAYOUT, records=64) as ring:
        ready.set()
        frame = 0
        while not enough.is_set():
            for _ in range(100):
                write(ring, frame)
                frame += 1
            write_images(ring, frame)


def test_commands_and_the_loops_state(name: str) -> None:
    with TelemetryRing.create(name, LAYOUT, commands=3, reference=np.arange(2.0), records=4) as ring:
        for frame in range(6):
            ring.write(frame, 0, 0, (0, 0), slopes_of(frame), loop=frame % 3, commands=np.arange(3.0) + frame)
        reader = TelemetryRing.attach(name)
        assert reader.description["reference"] == [0.0, 1.0]
        records, _, _ = reader.records.since(2)
        np.testing.assert_array_equal(records["frame"], [3, 4, 5])
        np.testing.assert_array_equal(records["loop"], records["frame"] % 3)
        np.testing.assert_array_equal(records["commands"], np.arange(3.0) + records["frame"][:, None])
        np.testing.assert_array_equal(records["x"][2], slopes_of(5).x)


def test_what_is_written_is_read(name: str) -> None:
    before = time.time_ns() - time.monotonic_ns()
    options: dict[str, Any] = {
        "settings": SETTINGS,
        "methods": ["none", "tv"],
        "records": 16,
        "image_slots": 3,
    }
    with TelemetryRing.create(name, LAYOUT, **options) as ring:
        reader = TelemetryRing.attach(name)
        assert reader.layout == LAYOUT
        assert reader.description["settings"] == SETTINGS
        assert reader.description["methods"] == ["none", "tv"]
        slopes = slopes_of(0)
        ring.write(0, 0, 0, (7, 507), slopes)
        slopes.x[:] = -1  # what was written stays
        for frame in range(1, 5):
            write(ring, frame)
        records, cursor, dropped = reader.records.since(0)
        assert (len(records), cursor, dropped, reader.records.written) == (5, 5, 0, 5)
        assert as_written(records)
        # The wall clock may be corrected by some milliseconds meanwhile.
        assert np.all(np.abs(records["clock_offset_ns"] - before) < 1e9)
        some, cursor, _ = reader.records.since(1, most=2)
        assert list(some["frame"]) == [1, 2]
        assert cursor == 3
        write_images(ring, 4)
        images, image_cursor, dropped = reader.images.since(0)
        assert (image_cursor, dropped, reader.images.written) == (1, 0, 1)
        assert images["denoised"].shape == (1, N, 8, 8)
        assert not is_stale(reader)
    assert is_stale(reader)
    assert as_written(reader.records.since(0)[0])  # what is there can still be read
    reader.close()
    with refused("start the engine first"):
        TelemetryRing.attach(name)


def test_memory_is_bounded(name: str) -> None:
    """So that it fits into the shared memory that containers have; 64 MiB by default."""
    layout = Layout.grid((40, 40), pixels=16)
    with TelemetryRing.create(name, layout) as ring:
        assert (FOLDER / f"{name}_telemetry").stat().st_size < 52 << 20
        ring.write_images(0, np.zeros(layout.frame_shape), np.zeros((1600, 16, 16)))
        assert len(TelemetryRing.attach(name).images.since(0)[0]) == 1


def test_changes_are_read_with_their_frames(name: str) -> None:
    with TelemetryRing.create(name, LAYOUT) as ring:
        reader = TelemetryRing.attach(name)
        ring.write_change(12, 1, {"noise_std": 2.5, "rule": "threshold"}, [1, 2])
        ring.write_change(13, 2, {"noise_std": np.linspace(0, 1, 1000)}, None)
        first, second = reader.changes_since(0)[0]
        assert first == {
            "frame": 12,
            "number": 1,
            "changes": {"noise_std": 2.5, "rule": "threshold"},
            "where": [1, 2],
        }
        assert (second["frame"], second["number"]) == (13, 2)
        assert second["changes"] == {"noise_std": "too long"}
        assert second["too_long_bytes"] > 4096


def test_nothing_is_torn_between_processes(name: str) -> None:
    spawn = multiprocessing.get_context("spawn")
    ready, enough = spawn.Event(), spawn.Event()
    with process(write_on, name, ready, enough) as writer:
        assert ready.wait(LIMIT_S)
        reader = TelemetryRing.attach(name)
        cursor = image_cursor = seen = lost = 0
        end = time.monotonic() + LIMIT_S
        while (seen < 2000 or lost == 0 or image_cursor < 20) and time.monotonic() < end:
            records, cursor, dropped = reader.records.since(cursor)
            assert as_written(records)
            assert np.array_equal(records["sequence"], np.arange(cursor - len(records), cursor))
            images, image_cursor, _ = reader.images.since(image_cursor)
            for image in images:
                assert np.all(image["raw"] == image["image_frame"])
                assert np.all(image["denoised"] == image["image_frame"] + 0.5)
            seen, lost = seen + len(records), lost + dropped
        assert seen + lost == cursor
        assert seen >= 2000
        enough.set()
        writer.join(LIMIT_S)
        assert writer.exitcode == 0
    assert is_stale(reader)


def test_what_is_not_telemetry_is_refused(name: str, tmp_path: Path) -> None:
    with (
        PixelRing.create(f"{name}_telemetry", (4, 4), np.uint8),
        refused("ring of telemetry", "pixel ring"),
    ):
        TelemetryRing.attach(name)
    for wrong in ({"records": 1}, {"records": 1e9}, {"image_slots": 0}):
        with refused(*wrong):
            TelemetryRing.create(name, LAYOUT, **wrong)
