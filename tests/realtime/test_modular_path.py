"""Modules in the engine's way of a frame: right slopes, and after every fault those of the built-in path."""

from __future__ import annotations

import gc
import re
import threading
import time
import weakref
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.realtime.module_cases import assert_same, frames, module, pipeline

import faintspot as fs
from faintspot.realtime.frame_path import FramePath, Progress
from faintspot.realtime.modular import ModularPipeline
from faintspot.realtime.modular_path import ModularPath
from faintspot.realtime.time_limit import call_within

SLOTS = 3
PATIENCE_S = 20.0
GENEROUS_S = 5.0  # budget of those that are not to exceed it
DOUBLE = "return images * 2"
# Fails on the frame that follows: it has a pixel brighter than any in the trial.
FAILING = "if images.max() > 1e6:\n    {}\nreturn images"


class Source:
    """Slots with whole frames in them, and a way through modules."""

    def __init__(self, folder: Path, stage: str, body: str, budget_s: float = GENEROUS_S) -> None:
        self.slots = np.zeros((SLOTS, *pipeline().layout.frame_shape), np.float32)
        self.cells = np.array([-1, 0], np.int64)
        progress = Progress(self.cells, 0, 1)
        self.plain = pipeline()
        self.modular = ModularPipeline(self.plain, module(folder, stage, body))
        self.fallback = FramePath(self.plain, self.slots, progress)
        self.path = ModularPath(self.modular, self.slots, progress, self.fallback, budget_s=budget_s)
        self.path.warm_up()

    def write(self, number: int, frame: Any) -> None:
        self.slots[number % SLOTS] = frame
        self.cells[1] = len(frame)
        self.cells[0] = number


def broken(frame: Any) -> Any:
    other = frame.astype(np.float32)
    corner = pipeline().layout.corners[7]
    other[corner[0] + 2, corner[1] + 2] = 1e7
    return other


def test_slopes_are_those_of_the_modular_pipeline(tmp_path: Path) -> None:
    source = Source(tmp_path, "denoise", DOUBLE)
    for number, frame in enumerate(frames(4).astype(np.float32)):
        threading.Timer(0.01, source.write, (number, frame)).start()
        assert source.path.measure(number, explain=True)
        found = fs.Slopes(*(value.copy() for value in vars(source.path.slopes).values()))
        assert_same(found, source.modular(frame))
        denoised = source.path.denoised
        assert np.array_equal(denoised, 2 * source.plain.explain(frame).calibrated)
    assert source.path.fault is None
    assert source.path.pipeline is source.plain


def test_images_of_other_stages(tmp_path: Path) -> None:
    """Telemetry sees what was denoised, also where another stage is a module."""
    frame = frames(1)[0].astype(np.float32)
    for stage in ("background", "centroid"):
        body = "images[:] = 1\nreturn images" if stage == "background" else "return images[:, 0, :2] * 0"
        source = Source(tmp_path, stage, body)
        source.write(0, frame)
        assert source.path.measure(0, 0, explain=True)
        assert np.array_equal(source.path.denoised, source.plain.explain(frame).denoised)


@pytest.mark.parametrize(
    ("action", "fault"),
    [
        ("raise ValueError('too bright')", r"module module \(denoise\): ValueError: too bright"),
        ("images[7] = np.nan", r"module module \(denoise\): returned NaN or infinite for 1 sub-apertures"),
        ("return images[1:]", r"expected shape \(20, 8, 8\), got \(19, 8, 8\)"),
        ("raise SystemExit", "SystemExit"),
    ],
)
def test_a_fault_is_one_frame_of_the_built_in_path(tmp_path: Path, action: str, fault: str) -> None:
    source = Source(tmp_path, "denoise", FAILING.format(action))
    data = frames(3).astype(np.float32)
    data[1] = broken(data[1])
    for number, frame in enumerate(data):
        source.write(number, frame)
        assert source.path.measure(number)
        if number:
            assert_same(source.path.slopes, source.plain(frame))
    assert source.path.fault is not None
    assert "\n" not in source.path.fault
    assert source.path.faulty_stage == "denoise"
    again = ModularPath(source.modular, source.slots, Progress(source.cells, 0, 1), source.fallback)
    again.warm_up()
    assert again.fault == source.path.fault  # what was given up stays so, also for another source
    assert again.measure(2)
    assert_same(again.slopes, source.plain(data[2]))
    assert re.search(fault, source.path.fault)


@pytest.mark.parametrize("action", ["while True: pass", "time.sleep(3)"])
def test_a_module_that_never_returns(tmp_path: Path, action: str) -> None:
    source = Source(tmp_path, "denoise", FAILING.format(action), 0.02)
    data = frames(3).astype(np.float32)
    data[1] = broken(data[1])
    for number, frame in enumerate(data):
        source.write(number, frame)
        assert source.path.measure(number)
    assert_same(source.path.slopes, source.plain(data[2]))
    assert "module module (denoise): did not return within 2" in str(source.path.fault)
    if "while" in action:  # Python code ends where it is told to
        end = time.monotonic() + 10
        while source.path._thread.is_alive() and time.monotonic() < end:
            time.sleep(0.01)
        assert not source.path._thread.is_alive()


def test_a_module_that_is_too_slow(tmp_path: Path) -> None:
    """Two late frames are still those of the module; the third one in a row is a fault."""
    source = Source(tmp_path, "denoise", "time.sleep(0.05)\nreturn images * 2", 0.04)
    frame = frames(1)[0].astype(np.float32)
    for number in range(3):
        source.write(number, frame)
        assert source.path.measure(number)
        assert (source.path.fault is None) == (number < 2)
    assert "module module (denoise): 3 frames in a row took longer than 40000 us in modules, " in str(
        source.path.fault
    )
    assert_same(source.path.slopes, source.plain(frame))


def test_single_late_frames_are_no_fault(tmp_path: Path) -> None:
    """A frame in time in between begins the count anew."""
    source = Source(tmp_path, "denoise", "time.sleep(0.5 * (images.max() > 1e6))\nreturn images", 0.25)
    data = frames(2).astype(np.float32)[1]
    for number, late in enumerate([True, True, False, True, True]):
        source.write(number, broken(data) if late else data)
        assert source.path.measure(number)
    assert source.path.fault is None


def test_lateness_while_another_module_is_tried_is_no_fault(tmp_path: Path) -> None:
    source = Source(tmp_path, "denoise", "time.sleep(0.3 * (images.max() > 1e6))\nreturn images", 0.02)
    data, over = broken(frames(2)[1]), threading.Event()
    trial = threading.Thread(target=call_within, args=(PATIENCE_S, "trial", over.wait))
    trial.start()
    for number in range(4):
        source.write(number, data)
        assert source.path.measure(number)
    assert source.path.fault is None
    over.set()
    trial.join()
    source.write(4, data)
    assert source.path.measure(4)
    assert source.path.fault is not None


def test_waiting_ends_when_told(tmp_path: Path) -> None:
    source = Source(tmp_path, "denoise", DOUBLE)
    threading.Timer(0.05, source.path.stop).start()
    assert not source.path.measure(0)
    assert source.path.stopped
    source.path.go_on()
    source.write(0, frames(1)[0])
    assert source.path.measure(0)


def test_a_path_that_is_forgotten_ends_its_thread(tmp_path: Path) -> None:
    source = Source(tmp_path, "denoise", DOUBLE)
    thread, path = source.path._thread, weakref.ref(source.path)
    del source
    gc.collect()
    assert path() is None
    thread.join(10)
    assert not thread.is_alive()
