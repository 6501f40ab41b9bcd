import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("zarr")

from tests.engine.page.cases import LAYOUT, N, next_batch, records

from faintspot.base.errors import InputError
from faintspot.engine.page import engine_source as recording_source
from faintspot.engine.page.client_requests import answered
from faintspot.engine.page.engine_source import RecordingSource, indices_of
from faintspot.engine.telemetry.recorder import TelemetryStore
from faintspot.engine.telemetry.ring import image_type, layout_values
from faintspot.io.telemetry import StoredTelemetry

FRAMES = 10_000
"""100 s; chunks of slopes hold 8192 frames."""


class Clock:
    """Time as the tests say."""

    now = 0.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(recording_source, "time", clock)
    return clock


@pytest.fixture(scope="module")
def night(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = records(0, FRAMES)
    made["x"] = np.arange(FRAMES)[:, None]
    images = np.zeros(100, image_type(LAYOUT.frame_shape, N, LAYOUT.window))
    images["image_frame"] = 100 * np.arange(100)
    images["raw"] = images["image_frame"][:, None, None]
    path = tmp_path_factory.mktemp("night") / "night.zarr"
    change = {"frame": 5000, "number": 1, "changes": {"noise_std": 2.0}, "where": None}
    attributes = {"layout": layout_values(LAYOUT), "settings": "[settings]", "methods": ["set"]}
    store = TelemetryStore(path, made.dtype, images.dtype, attributes)
    store.append(made, images, {"changes": [change]})
    shutil.rmtree(path / "covariance_xy")  # recordings without it are played, too
    return path


def test_recording_is_played_at_its_own_pace(night: Path, clock: Clock) -> None:
    source = RecordingSource(night)
    assert source.length_s == pytest.approx((FRAMES - 1) / 100)
    first = next_batch(source)
    assert first.anew
    assert first.records["frame"].tolist() == [0]
    clock.now += 1.0
    batch = next_batch(source)
    assert not batch.anew
    assert batch.records["frame"].tolist() == list(range(1, 101))
    np.testing.assert_array_equal(batch.records["x"][:, 0], batch.records["frame"])
    assert batch.picture is not None
    assert batch.picture.frame == 100
    assert batch.picture.raw[0, 0] == 100
    clock.now += 0.5
    again = next_batch(source)
    assert again.picture is None
    assert len(again.records) == 50


def test_time_bar_speed_and_pause(night: Path, clock: Clock) -> None:
    source = RecordingSource(night)

    def ask(**asked: Any) -> None:
        assert answered(source.functions(), {"do": "play", **asked})["ok"]

    def read() -> Any:
        return next_batch(source)

    read()
    ask(position_s=81.0, speed=4.0)  # across the end of a chunk at 8192 frames
    moved = read()
    assert moved.anew
    assert moved.records["frame"].tolist() == [8100]
    assert moved.picture.frame == 8100
    assert [change["frame"] for change in moved.changes] == [5000]
    clock.now += 1.0
    batch = read()
    np.testing.assert_array_equal(batch.records["x"][:, 0], np.arange(8101, 8501))
    ask(playing=False)
    clock.now += 5.0
    assert not len(read().records)
    assert source.state()["playing"] is False
    ask(position_s=10.0)
    assert read().records["frame"].tolist() == [1000]
    ask(position_s=1e9, playing=True)
    clock.now += 1.0
    assert read().records["frame"].tolist() == [FRAMES - 1]
    assert source.state()["playing"] is False  # it is over
    ask(playing=True)
    read()
    assert source.state()["position_s"] == 0.0


def test_changes_are_told_when_they_come(night: Path, clock: Clock) -> None:
    source = RecordingSource(night)
    answered(source.functions(), {"do": "play", "position_s": 49.9})
    batch = next_batch(source)
    assert batch.changes == []
    clock.now += 1.0
    batch = next_batch(source)
    assert len(batch.changes) == 1


@pytest.mark.parametrize(
    ("asked", "error"),
    [
        ({"position_s": -1}, "position_s = -1: expected a number of at least 0"),
        ({"position_s": "x"}, "position_s"),
        ({"position_s": float("nan")}, "position_s"),
        ({"speed": 0}, "speed = 0: expected a number from 0.01 to 100"),
        ({"playing": "yes"}, "playing = 'yes': expected true or false"),
    ],
)
def test_what_cannot_be_played(night: Path, asked: dict[str, Any], error: str) -> None:
    answer = answered(RecordingSource(night).functions(), {"do": "play", **asked})
    assert not answer["ok"]
    assert error in answer["error"]


def test_pictures_of_a_camera_that_began_anew_are_found_behind_those_before() -> None:
    frames = np.array([0, 1, 2, 3, 0, 1, 2, 3])
    assert indices_of(np.array([1, 3, 1, 3]), frames).tolist() == [1, 3, 5, 7]
    assert indices_of(np.array([9, 2]), frames).tolist() == [0, 2]


def test_what_is_no_recording_is_refused(tmp_path: Path, night: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        RecordingSource(tmp_path / "none.zarr")
    with pytest.raises(InputError, match="expected a Zarr store of telemetry"):
        RecordingSource(tmp_path)
    with pytest.raises(InputError, match="expected a recording with frames"):
        RecordingSource(stored(tmp_path, 0))


def stored(folder: Path, frames: int, shape: tuple[int, int] = LAYOUT.frame_shape, **changed: Any) -> Path:
    """Write a recording of so many frames and one image, with other attributes if there are any."""
    made, images = records(0, frames), image_type(shape, N, LAYOUT.window)
    attributes = {"layout": layout_values(LAYOUT), "methods": []}
    store = TelemetryStore(folder / "night.zarr", made.dtype, images, attributes)
    if frames:
        store.append(made, np.zeros(1, images), {"changes": []} | changed)
    return folder / "night.zarr"


def test_recording_of_another_sensor_than_it_says_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"damaged \(raw: expected items of"):
        RecordingSource(stored(tmp_path, 5, (4, 4)))


@pytest.mark.parametrize(
    "wrong", [{"layout": {}}, {"layout": 5}, {"changes": [{}]}, {"changes": [{"frame": "x"}]}]
)
def test_attributes_that_make_no_sense_are_one_line(tmp_path: Path, wrong: dict[str, Any]) -> None:
    with pytest.raises(InputError, match="the store is damaged"):
        RecordingSource(stored(tmp_path, 5, **wrong))


def test_parts_of_a_store_are_those_of_the_whole(night: Path) -> None:
    store = StoredTelemetry(night)
    assert (store.frames, store.images) == (FRAMES, 100)
    assert store.read("x", 8190, 8195)[:, 0].tolist() == [8190, 8191, 8192, 8193, 8194]
    assert "x" in store
    assert "commands" not in store
    with pytest.raises(InputError, match="damaged"):
        store.read("nothing", 0, 1)
    with pytest.raises(InputError, match="damaged"):
        store.read("x", 0, FRAMES + 1)
