"""An engine and a simulated camera or telescope as processes of their own, and what they say of a run."""

import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np

import faintspot as fs
from faintspot.base.errors import InputError
from faintspot.engine.processes.requests import request, socket_path
from faintspot.slopes.simulate import Detector, sensor_frames

CONFIGURATION = """
[layout.grid]
shape = [{across}, {across}]
pixels = {pixels}
outer_radius = {outer_radius}
inner_radius = {inner_radius}

[estimator]
name = "tv"
noise_std = {noise_std}
keep_brightest = 12
tolerance = {tolerance}
max_iterations = {iterations}

[calibration]
read_noise_e = 1.0
"""
SMALL = {"across": 7, "pixels": 16, "outer_radius": 3.5, "inner_radius": 0.5}
"""36 sub-apertures of 16 x 16 pixels."""
USUAL = {"noise_std": 1.0, "tolerance": 0.0, "iterations": 10}
_COMMAND = [sys.executable, "-m", "faintspot", "realtime"]
PATIENCE_S, _REPLAYED = 120.0, 100


class Processes:
    """An engine and a camera that run."""

    def __init__(self, name: str, engine: subprocess.Popen[bytes], camera: subprocess.Popen[bytes]) -> None:
        self.name, self.engine, self.camera = name, engine, camera

    def status(self) -> dict[str, Any]:
        """Return the engine's own status."""
        return request(socket_path(self.name), "status")

    def until_processed(self, frames: int) -> dict[str, Any]:
        """Wait until so many frames have been measured; return the status."""
        end = time.monotonic() + PATIENCE_S
        while time.monotonic() < end:
            time.sleep(0.5)
            try:
                status = self.status()
            except InputError:
                continue  # not there yet
            if status["counters"]["processed"] >= frames:
                return status
        raise TimeoutError(f"{frames} frames were not measured within {PATIENCE_S} s")


@contextmanager
def engine_and_camera(
    values: dict[str, Any],
    camera: Sequence[str],
    engine: Sequence[str] = (),
    priority: int = 0,
    flux_e: float = 200.0,
) -> Iterator[Processes]:
    """Start both with a configuration of these values, perhaps with real-time priority; end them.

    The camera replays simulated frames again and again, with options of `faintspot realtime replay`.
    """
    name = f"faintspot_benchmark_{uuid4().hex[:8]}"
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "faintspot.toml"
        path.write_text(CONFIGURATION.format(**values))
        detector, rng = Detector(1.0), np.random.default_rng(1)
        frames, _ = sensor_frames(fs.Layout.load(path), _REPLAYED, flux_e=flux_e, detector=detector, rng=rng)
        np.save(path.with_name("frames.npy"), frames)
        first = ["chrt", "-f", str(priority)] if priority else []
        started = [
            subprocess.Popen(
                [*first, *_COMMAND, *arguments, "--name", name], cwd=folder, stdout=subprocess.DEVNULL
            )
            for arguments in (
                ["run", "--priority", str(priority), *engine],
                ["replay", "frames.npy", "--repeat", *camera],
            )
        ]
        try:
            yield Processes(name, *started)
        finally:
            for process in reversed(started):
                process.terminate()
                process.wait()


@contextmanager
def engine_and_telescope(
    name: str, engine: Path, loop: Path, telescope: Sequence[str] = (), priority: int = 0
) -> Iterator[tuple[Processes, subprocess.Popen[bytes]]]:
    """Start an engine with its loop closed, and the telescope as soon as it waits for frames; end them."""
    quiet: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    options = ["--config", str(engine), "--name", name, "--close-loop", "--images-every", "0"]
    started = [subprocess.Popen([*_COMMAND, "run", *options, "--priority", str(priority)], **quiet)]
    try:
        end = time.monotonic() + PATIENCE_S
        while time.monotonic() < end:
            with suppress(InputError):
                request(socket_path(name), "status")
                break
            time.sleep(0.2)
        first = ["chrt", "-f", str(priority)] if priority else []
        run = [*first, *_COMMAND, "telescope", str(loop), "--name", name, *telescope]
        started.append(subprocess.Popen(run, **quiet))
        yield Processes(name, *started), started[1]
    finally:
        for process in reversed(started):
            process.terminate()
            process.wait()


def involuntary_switches(pid: int) -> int:
    """How often the scheduler took a processor away from any thread of a process."""
    total = 0
    for status in Path(f"/proc/{pid}/task").glob("*/status"):
        for line in status.read_text().splitlines():
            if line.startswith("nonvoluntary_ctxt_switches"):
                total += int(line.split()[1])
    return total


def resident_bytes(pid: int) -> int:
    """Memory that a process holds."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * 4096
