"""Modules in a running engine: in, out, and out by themselves when they fail, without one frame missing."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.realtime.module_cases import LAYOUT, SETTINGS, frames, pipeline, write

from faintspot.errors import InputError
from faintspot.realtime.commands import commands_of
from faintspot.realtime.engine import Engine
from faintspot.realtime.modular import ModularPipeline
from faintspot.realtime.module_loading import load_module
from faintspot.realtime.pixel_ring import PixelRing

pyshmem = pytest.importorskip("pyshmem")
PATIENCE_S = 30.0
DEADLINE_S = 0.1  # generous: the machine may be busy


class Bench:
    """An engine in a thread, and a camera that sends it one frame after the other."""

    def __init__(self) -> None:
        name = f"fs_test_{uuid4().hex[:12]}"
        self.engine = Engine(name, pipeline, SETTINGS, deadline_s=DEADLINE_S)
        self.ask = commands_of(self.engine)
        self._thread = threading.Thread(target=self.engine.run)
        self._stream = pyshmem.open(f"{name}_slopes")
        self._ring = PixelRing.create(name, LAYOUT.frame_shape, np.float32)
        self._frames, self._number = frames(2).astype(np.float32), 0
        self._stopping, self._sending = threading.Event(), threading.Lock()
        self._thread.start()
        self._camera = threading.Thread(target=self._send_all)
        self._camera.start()

    def _send_all(self) -> None:
        while not self._stopping.wait(0.002):
            with self._sending:
                self._ring.publish(self._frames[1])

    def slopes_of(self, frame: NDArray[Any]) -> NDArray[np.float32]:
        """Send one frame, and nothing else, and return its slopes."""
        with self._sending:
            before = self.engine.counters.processed
            self.until(lambda: self._quiet(before))
            before = self.engine.counters.processed
            self._ring.publish(frame)
            self.until(lambda: self.engine.counters.processed > before)
            return np.array(self._stream.read_publication().payload)

    def _quiet(self, before: int) -> bool:
        time.sleep(0.05)
        newest = self._stream.read_publication().frame_id if self._stream.count else -1
        return bool(newest == self._ring.progress()[0])

    def until(self, condition: Any) -> None:
        end = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < end, self.engine.status()
            time.sleep(0.002)

    def close(self) -> None:
        self._stopping.set()
        self._camera.join()
        self.engine.stop()
        self._thread.join(PATIENCE_S)
        assert not self._thread.is_alive()
        self._ring.close()
        self._stream.close()


@pytest.fixture
def bench() -> Iterator[Bench]:
    bench = Bench()
    try:
        bench.until(lambda: bench.engine.counters.processed > 3)
        yield bench
    finally:
        bench.close()


def test_in_and_out(bench: Bench, tmp_path: Path) -> None:
    frame = frames(2)[1].astype(np.float32)
    assert np.array_equal(bench.slopes_of(frame), pipeline()(frame).vector)

    path = write(tmp_path, "denoise", "return np.maximum(images, 2)")
    assert bench.ask["load"]({"source": str(path)})["frame"] is not None
    modular = ModularPipeline(pipeline(), {"denoise": load_module(path)})
    assert np.array_equal(bench.slopes_of(frame), modular(frame).vector)

    changed = SETTINGS.replace(keep_brightest=5)  # settings change, the module stays
    assert bench.ask["set"]({"changes": {"keep_brightest": 5}})["frame"] is not None
    modular = ModularPipeline(pipeline(changed), {"denoise": load_module(path)})
    assert np.array_equal(bench.slopes_of(frame), modular(frame).vector)

    assert bench.ask["unload"]({"stage": "denoise"})["frame"] is not None
    assert np.array_equal(bench.slopes_of(frame), pipeline(changed)(frame).vector)
    counters = bench.engine.counters  # a machine that is busy with other things may lose some, and says so
    assert counters.frames_in == counters.processed + counters.dropped


def test_a_module_that_never_returns_is_taken_out(bench: Bench, tmp_path: Path) -> None:
    """Frames go on being measured meanwhile; the one that it was given is measured by the built-in stage."""
    path = write(tmp_path, "denoise", "while images.max() > 1e6:\n    pass\nreturn images * 2")
    bench.ask["load"]({"source": str(path)})
    frame = frames(2)[1].astype(np.float32)
    frame[20, 20] = 1e7
    assert np.array_equal(bench.slopes_of(frame), pipeline()(frame).vector)
    bench.until(lambda: bench.ask["modules"]({})["loaded"] == [])
    assert "module module (denoise): did not return" in bench.ask["modules"]({})["fault"]
    frame[20, 20] = 100
    assert np.array_equal(bench.slopes_of(frame), pipeline()(frame).vector)


def test_a_module_that_crashes_in_its_trial_is_never_loaded(bench: Bench, tmp_path: Path) -> None:
    path = write(tmp_path, "denoise", "import ctypes\nctypes.string_at(0)")
    with pytest.raises(InputError, match="crashed in its trial"):
        bench.ask["load"]({"source": str(path)})
    assert bench.engine.modules.modules() == {}
    assert bench.ask["set"]({"changes": {"keep_brightest": 5}})["frame"] is not None
