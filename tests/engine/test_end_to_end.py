"""Camera, engine and consumer as three processes: slopes are those of the pipeline, bit for bit."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from tests.patience import LIMIT_S, wait_for

import faintspot as fs
from faintspot.engine.frames.pixel_ring import PixelRing
from faintspot.engine.processes.requests import socket_path

pyshmem = pytest.importorskip("pyshmem")

pytestmark = pytest.mark.slow

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
def processes(name: str, tmp_path: Path) -> Iterator[list[subprocess.Popen[bytes]]]:
    """Start an engine and recorded frames in place of a camera; end them."""
    (tmp_path / "faintspot.toml").write_text(CONFIGURATION)
    frames = np.random.default_rng(3).poisson(103.0, (50, 32, 32)).astype(np.uint16)
    np.save(tmp_path / "frames.npy", frames)
    camera = f"replay frames.npy --name {name} --frame-rate-hz 200 --repeat".split()
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


def frames_measured(name: str) -> int:
    """Return how many frames the engine has measured; 0 while it starts and refuses to answer."""
    try:
        return int(json.loads(ask(name, "status", "--json"))["counters"]["processed"])
    except subprocess.CalledProcessError:
        return 0


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

    wait_for(enough, "slopes")
    stream.close()
    return found


def test_camera_engine_and_client_work_as_processes(
    name: str, processes: list[subprocess.Popen[bytes]], tmp_path: Path
) -> None:
    wait_for(lambda: socket_path(name).exists(), "the engine")
    wait_for(lambda: frames_measured(name) > 10, "frames")
    pipeline = fs.SlopePipeline.from_file(tmp_path / "faintspot.toml")
    for frame, slopes in captured(name, 30).values():
        assert np.array_equal(slopes, pipeline(frame).vector)

    assert "in effect from frame" in ask(name, "send", "noise_std=2.5", "keep_brightest=5")
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
