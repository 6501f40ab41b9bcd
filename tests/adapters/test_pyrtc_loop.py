"""pyRTC's whole loop: frames of a stream as its sensor, and the files for its manager."""

import logging
from collections.abc import Iterator
from typing import Any
from uuid import uuid4

import numpy as np
import pytest
from tests.adapters.adapter_cases import needs
from tests.engine.commands import needs_shared_memory
from tests.patience import wait_for
from tests.refusals import refused
from tests.shared_data import ROOT

import faintspot as fs
from faintspot import Settings
from faintspot.adapters import pyrtc
from faintspot.adapters.pyrtc import _Frames, _Measuring

SHAPE = (6, 5)
FILES = ROOT / "examples" / "pyrtc"
pyshmem = pytest.importorskip("pyshmem")
pytestmark = needs_shared_memory


@pytest.fixture
def name() -> Iterator[str]:
    chosen = f"faintspot_{uuid4().hex[:8]}"
    yield chosen
    pyshmem.unlink_quiet(chosen)


def create(name: str, values: Any) -> Any:
    values = np.asarray(values)
    stream = pyshmem.create(name, shape=values.shape, dtype=values.dtype)
    stream.write(values)
    return stream


def configuration(name: str) -> dict[str, Any]:
    return {"name": "wfs", "width": SHAPE[1], "height": SHAPE[0], "frames": name}


@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_frames_of_a_stream_also_when_it_is_made_anew(name: str, dtype: Any) -> None:
    frames, taken = _Frames(configuration(name)), np.zeros(SHAPE, np.uint16)
    assert not frames.next_into(taken)  # it is not there yet
    first = np.arange(30).reshape(SHAPE).astype(dtype)
    stream = create(name, first)
    wait_for(lambda: frames.next_into(taken))
    np.testing.assert_array_equal(taken, first)
    assert not frames.next_into(taken)  # the same is no new frame
    stream.write(first + 1)
    assert frames.next_into(taken)
    np.testing.assert_array_equal(taken, first + 1)
    if dtype == np.float32:  # numbers that do not fit are clipped
        stream.write(np.where(first < 15, -5.0, 7e4).astype(dtype))
        assert frames.next_into(taken)
        np.testing.assert_array_equal(taken, np.where(first < 15, 0, 65535))
    stream.unlink()
    create(name, np.full(SHAPE, 2, dtype))
    wait_for(lambda: frames.next_into(taken))
    assert (taken == 2).all()
    frames.close()


def test_frames_of_another_size_are_waited_out(name: str, caplog: pytest.LogCaptureFixture) -> None:
    for wfs, words in (
        ({"width": 5, "height": 6}, ["wfs.frames", "None"]),
        (configuration("isio:../x"), ["isio"]),
    ):
        with refused(*words):
            _Frames(wfs)
    frames, taken = _Frames(configuration(name)), np.zeros(SHAPE, np.uint16)
    wrong = create(name, np.ones((5, 6), np.uint16))
    with caplog.at_level(logging.WARNING):
        assert not frames.next_into(taken)
        assert not frames.next_into(taken)
    said = f"stream {name}: holds (5, 6) uint16, expected frames of 6 x 5 (wfs.height, wfs.width); waiting"
    assert [record.getMessage() for record in caplog.records] == [said]
    wrong.unlink()
    create(name, np.ones(SHAPE, np.uint16))
    wait_for(lambda: frames.next_into(taken))


@needs("pyrtc", "pyrtc")
@pytest.mark.filterwarnings("ignore")
def test_pyrtcs_sensor_has_the_frames(name: str) -> None:
    from pyrtc import WavefrontSensor, clear_shms
    from pyrtc.component_loading import resolve_class_symbol

    pyrtc.camera.cache_clear()
    ours = resolve_class_symbol("faintspot.adapters.pyrtc.FaintspotCamera")
    assert issubclass(ours, WavefrontSensor)
    streams = {stream: f"{name}_{stream}" for stream in ("wfs", "wfs_raw")}
    first = np.arange(30, dtype=np.uint16).reshape(SHAPE)
    create(name, first)
    try:
        component = ours({**configuration(name), "functions": [], "output_streams": streams})
        wait_for(lambda: (component.expose(), np.array_equal(component.read(block=False), first))[1])
        component.close(timeout=0.0)
    finally:
        clear_shms(streams.values())


def test_files_for_the_manager() -> None:
    yaml = pytest.importorskip("yaml")
    documents = {file.stem: yaml.safe_load(file.read_text(encoding="utf-8")) for file in FILES.glob("*.yaml")}
    for document in documents.values():
        assert list(document) == ["manager", "wfs", "slopes", "loop", "wfc"]
    assert _Measuring(documents["synthetic"]["slopes"]).parts.settings.estimator.name == "window"
    assert _Frames(documents["telescope"]["wfs"])
    layout, wfs = fs.Layout.load(FILES / "engine.toml"), documents["engine"]["wfs"]
    assert layout.frame_shape == (wfs["height"], wfs["width"])
    assert Settings.load(FILES / "engine.toml").estimator.name == "window"
