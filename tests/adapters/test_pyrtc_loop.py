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


@pytest.mark.parametrize("dtype", [np.uint16, np.float32, np.int32])
def test_frames_of_a_stream(name: str, dtype: Any) -> None:
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
    frames.close()


def test_numbers_that_do_not_fit_are_clipped(name: str) -> None:
    frames, taken = _Frames(configuration(name)), np.zeros(SHAPE, np.uint16)
    create(name, np.full(SHAPE, -5.0, np.float32)).write(np.full(SHAPE, 7e4, np.float32))
    assert frames.next_into(taken)
    assert (taken == 65535).all()
    frames.close()


def test_a_stream_that_is_made_anew(name: str) -> None:
    frames, taken = _Frames(configuration(name)), np.zeros(SHAPE, np.uint16)
    first = create(name, np.ones(SHAPE, np.uint16))
    assert frames.next_into(taken)
    first.unlink()
    create(name, np.full(SHAPE, 2, np.uint16))
    wait_for(lambda: frames.next_into(taken))
    assert (taken == 2).all()
    frames.close()


def test_frames_of_another_size_are_waited_out(name: str, caplog: pytest.LogCaptureFixture) -> None:
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


def test_frames_refused_in_one_line() -> None:
    with refused("wfs.frames", "None"):
        _Frames({"width": 5, "height": 6})
    with refused("isio"):
        _Frames(configuration("isio:../x"))


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


@pytest.mark.parametrize("file", ["synthetic", "telescope", "engine"])
def test_files_for_the_manager(file: str) -> None:
    yaml = pytest.importorskip("yaml")
    document = yaml.safe_load((FILES / f"{file}.yaml").read_text(encoding="utf-8"))
    assert list(document) == ["manager", "wfs", "slopes", "loop", "wfc"]
    if file == "synthetic":
        measuring = _Measuring(document["slopes"])
        assert measuring.parts.settings.estimator.name == "window"
    if file == "telescope":
        assert _Frames(document["wfs"])
    if file == "engine":
        layout = fs.Layout.load(FILES / "engine.toml")
        assert layout.frame_shape == (document["wfs"]["height"], document["wfs"]["width"])
        assert Settings.load(FILES / "engine.toml").estimator.name == "window"
