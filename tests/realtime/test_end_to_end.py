"""Camera, engine and consumer as three processes: slopes are those of the pipeline, bit for bit."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from uuid import uuid4

import numpy as np
import pytest
from tests.patience import LIMIT_S

import faintspot as fs
from faintspot.realtime.pixel_ring import PixelRing
from faintspot.realtime.private_socket import socket_path

pyshmem = pytest.importorskip("pyshmem")

pytestmark = pytest.mark.machine_time("clocks, threads and other processes")

CONFIGURATION = """
[layout.grid]
shape = [4, 4]
pixels = 8

[estimator]
name = "tv"
noise_std = 1.0
keep_brightest = 9

[calibration]
dark = 100.0
read_noise_e = 1.0
"""
COMMAND = [sys.executable, "-m", "faintspot", "realtime"]


@pytest.fixture
def name() -> str:
    return f"fs_test_{uuid4().hex[:12]}"


@pytest.fixture
def processes(name: str, tmp_path: Path) -> Iterator[list[subprocess.Popen[bytes]]]:
    """Start camera and engine; end them."""
    (tmp_path / "faintspot.toml").write_text(CONFIGURATION)
    camera = [
        "camera",
        "--name",
        name,
        "--frame-rate-hz",
        "200",
        "--offset-adu",
        "100",
        "--bits",
        "16",
        "--seed",
        "3",
    ]
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    started = []
    for arguments in (["run", "--name", name], camera):
        with (tmp_path / f"{arguments[0]}.log").open("w") as log:
            command = [*COMMAND, *arguments]
            started.append(subprocess.Popen(command, cwd=tmp_path, env=environment, stdout=log))
    yield started
    for process in started:
        process.send_signal(signal.SIGINT)  # so that it removes its shared memory; nothing where it has ended
        try:
            process.wait(LIMIT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def ask(name: str, *arguments: str) -> str:
    command = [*COMMAND, *arguments, "--name", name]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def wait_for(what: object, condition: object) -> None:
    end = time.monotonic() + LIMIT_S
    while not condition():  # type: ignore[operator]
        assert time.monotonic() < end, what
        time.sleep(0.01)


def captured(name: str, count: int) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Frames and slopes of the same number, as another process sees them."""
    stream, ring = pyshmem.open(f"{name}_slopes"), PixelRing.attach(name)
    found: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    def enough() -> bool:
        if stream.count:
            publication = stream.read_publication()
            number = publication.frame_id
            frame = ring.slot(number).copy()
            if ring.intact(number):
                found[number] = frame, np.array(publication.payload)
        return len(found) >= count

    wait_for("slopes", enough)
    stream.close()
    return found


@pytest.mark.portable
def test_three_processes(name: str, processes: list[subprocess.Popen[bytes]], tmp_path: Path) -> None:
    wait_for("the engine", lambda: socket_path(name).exists())
    wait_for("frames", lambda: json.loads(ask(name, "status", "--json"))["counters"]["processed"] > 10)
    pipeline = fs.SlopePipeline.from_file(tmp_path / "faintspot.toml")
    for frame, slopes in captured(name, 30).values():
        assert np.array_equal(slopes, pipeline(frame).vector)

    assert "in effect from frame" in ask(name, "set", "noise_std=2.5", "keep_brightest=5")
    changed = fs.SlopePipeline(
        pipeline.layout, pipeline.settings.replace(noise_std=2.5, keep_brightest=5), pipeline.calibration
    )
    for frame, slopes in captured(name, 30).values():
        assert np.array_equal(slopes, changed(frame).vector)

    engine, camera = processes
    camera.send_signal(signal.SIGINT)
    assert camera.wait(LIMIT_S) == 0
    ask(name, "stop")
    assert engine.wait(LIMIT_S) == 0
    assert "frames measured" in (tmp_path / "run.log").read_text()
    assert not socket_path(name).exists()


def test_a_killed_engine_is_replaced(
    name: str, processes: list[subprocess.Popen[bytes]], tmp_path: Path
) -> None:
    """What it leaves in shared memory is recognised and cleaned up; the camera does not notice."""
    wait_for("the engine", lambda: socket_path(name).exists())
    wait_for("frames", lambda: json.loads(ask(name, "status", "--json"))["counters"]["processed"] > 10)
    captured(name, 3)
    processes[0].kill()
    processes[0].wait()
    with (tmp_path / "again.log").open("w") as log:
        again = subprocess.Popen([*COMMAND, "run", "--name", name], cwd=tmp_path, stdout=log)
    processes.append(again)
    wait_for("the new engine", lambda: "waiting for frames" in (tmp_path / "again.log").read_text())
    pipeline = fs.SlopePipeline.from_file(tmp_path / "faintspot.toml")
    for frame, slopes in captured(name, 10).values():
        assert np.array_equal(slopes, pipeline(frame).vector)
    ask(name, "stop")
    assert again.wait(LIMIT_S) == 0
