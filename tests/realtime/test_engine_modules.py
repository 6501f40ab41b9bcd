"""Modules in a running engine: no frame is lost when they come, go, or fail."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tests.realtime.bench import SETTINGS, Bench, make, simulated

import faintspot as fs
from faintspot.realtime.modular import ModularPipeline
from faintspot.realtime.module_loading import Module, load_module
from faintspot.realtime.pixel_ring import PixelRing

HALVED = """
STAGE = "denoise"
def make(layout, settings):
    return lambda images: images * 0.5 + images.mean()
"""
# Good while it is tried, and for ten frames in the loop.
LATER = """
import time
import numpy as np
STAGE = "denoise"
calls = [0]
def make(layout, settings):
    def denoise(images):
        calls[0] += 1
        if calls[0] > 60:
            {fault}
        return images * 0.5 + images.mean()
    return denoise
"""


def module(folder: Path, text: str, name: str = "halved") -> Module:
    path = folder / f"{name}.py"
    path.write_text(text)
    return load_module(path)


class Camera:
    """Sends frames one after the other, and remembers them."""

    def __init__(self, bench: Bench, ring: PixelRing) -> None:
        self.bench, self.ring, self.data, self.sent = bench, ring, simulated(8), 0

    def send(self, n: int = 1) -> None:
        for _ in range(n):
            self.bench.send(self.ring, self.sent, self.data[self.sent % 8])
            self.sent += 1

    def assert_measured_with(self, pipeline: ModularPipeline | fs.SlopePipeline, frame: int) -> None:
        expected = pipeline(self.data[frame % 8]).vector
        assert np.array_equal(self.bench.slopes[frame], expected), frame


@pytest.fixture
def slow_bench() -> object:
    bench = Bench(deadline_s=0.5)  # a shared machine may take long
    yield bench
    bench.close()


def test_load_and_unload(slow_bench: Bench, tmp_path: Path) -> None:
    bench, halved = slow_bench, module(tmp_path, HALVED)
    with bench.ring() as ring:
        camera = Camera(bench, ring)
        bench.attached()
        camera.send()
        bench.engine.modules.load(halved)
        camera.send(2)  # the first one may have been waited for already
        bench.engine.modules.unload("denoise")
        camera.send(2)
    camera.assert_measured_with(make(SETTINGS), 0)
    camera.assert_measured_with(ModularPipeline(make(SETTINGS), {"denoise": halved}), 2)
    camera.assert_measured_with(make(SETTINGS), 4)
    assert bench.engine.counters.processed == 5
    assert bench.engine.modules.module_fault() is None


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("return images[:-1]", "shape"),
        ("images = images * np.nan", "finite"),
        ("raise RuntimeError('out of order')", "out of order"),
        ("time.sleep(60)", "did not return"),
    ],
)
def test_a_module_that_fails_is_taken_out(tmp_path: Path, fault: str, message: str) -> None:
    """The frame that it failed on, and all others, are measured by the built-in stage instead."""
    bench = Bench(deadline_s=0.2)
    try:
        with bench.ring() as ring:
            camera = Camera(bench, ring)
            bench.attached()
            bench.engine.modules.load(module(tmp_path, LATER.format(fault=fault), "later"))
            for _ in range(2000):
                camera.send()
                if bench.engine.live.change_number == 2:  # loaded, and taken out
                    break
        assert bench.engine.counters.processed == camera.sent
        assert message in str(bench.engine.modules.module_fault())
        assert "later" in str(bench.engine.modules.module_fault())
        camera.assert_measured_with(make(SETTINGS), camera.sent - 1)
    finally:
        bench.close()


def test_the_module_before_comes_back(slow_bench: Bench, tmp_path: Path) -> None:
    bench, halved = slow_bench, module(tmp_path, HALVED)
    with bench.ring() as ring:
        camera = Camera(bench, ring)
        bench.attached()
        bench.engine.modules.load(halved)
        bench.engine.modules.load(module(tmp_path, LATER.format(fault="raise ValueError"), "later"))
        for _ in range(2000):
            camera.send()
            if bench.engine.live.change_number == 3:  # load, load, and back
                break
        camera.send()
    camera.assert_measured_with(ModularPipeline(make(SETTINGS), {"denoise": halved}), camera.sent - 1)


def test_a_refused_module_changes_nothing(bench: Bench, tmp_path: Path) -> None:
    bad = module(tmp_path, "STAGE = 'denoise'\ndef make(layout, settings):\n    return lambda images: None\n")
    with pytest.raises(fs.InputError, match="halved"):
        bench.engine.modules.load(bad)
    assert bench.engine.modules.modules() == {}
    assert bench.engine.live.change_number == 0


def test_any_failure_takes_back_what_was_loaded(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not only refusals: settings can be changed afterwards, and nothing is loaded."""

    def fail(*arguments: object) -> None:
        raise MemoryError

    with monkeypatch.context() as patch:
        patch.setattr(bench.engine.preparer, "of_arms", fail)
        with pytest.raises(MemoryError):
            bench.engine.modules.load(module(tmp_path, HALVED))
    assert bench.engine.modules.modules() == {}
    bench.engine.live.propose({"noise_std": 2.0})
    assert bench.engine.live.waiting() == 1
