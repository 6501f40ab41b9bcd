"""How long after its last row are a frame's slopes there: streamed by rows, and measured as a whole?

The engine and a simulated camera run as processes of their own, 36 sub-apertures of 16 x 16 pixels at 300
frames/s. Streamed: the camera publishes four rows at a time, at the pace of a read-out that takes 80 % of the
frame time. Whole: the same frames, published in one piece. The time is from the last row's arrival to the
publication of the last slope, as the engine itself measures it; two processors at least should be free.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any
from uuid import uuid4

from benchmarks.measuring import Row, Table
from faintspot.errors import InputError
from faintspot.realtime.control import request
from faintspot.realtime.private_socket import socket_path

FRAMES, RATE_HZ, ROWS = 2000, 300, 112
ITERATIONS = (10, 20)
LIMIT = 0.3
_CONFIGURATION = """
[layout.grid]
shape = [7, 7]
pixels = 16
outer_radius = 3.5
inner_radius = 0.5

[settings]
noise_std = 1.0
keep_brightest = 12
tolerance = 0.0
max_iterations = {iterations}

[calibration]
read_noise_e = 1.0
"""
_COMMAND = [sys.executable, "-m", "faintspot", "realtime"]
_PATIENCE_S = 120.0


def _latency(iterations: int, rows_per_block: int) -> dict[str, Any]:
    """Return the engine's latencies over FRAMES frames."""
    name = f"faintspot_benchmark_{uuid4().hex[:8]}"
    path = socket_path(name)
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "faintspot.toml").write_text(_CONFIGURATION.format(iterations=iterations))
        camera = ["camera", "--rate", str(RATE_HZ), "--rows-per-block", str(rows_per_block), "--seed", "1"]
        processes = [
            subprocess.Popen([*_COMMAND, *arguments, "--name", name], cwd=folder, stdout=subprocess.DEVNULL)
            for arguments in (["run"], camera)
        ]
        try:
            end = time.monotonic() + _PATIENCE_S
            while time.monotonic() < end:
                time.sleep(0.5)
                try:
                    status = request(path, "status")
                except InputError:
                    continue  # not there yet
                if status["counters"]["processed"] >= FRAMES:
                    break
            request(path, "stop")
        finally:
            for process in processes:
                process.terminate()
                process.wait()
    latency: dict[str, Any] = status["latency"]
    return latency


def run() -> list[Table]:
    """Measure both ways for each number of iterations."""
    rows = []
    for iterations in ITERATIONS:
        streamed, whole = _latency(iterations, 4), _latency(iterations, ROWS)
        values = {
            f"{way} {name}": latency[f"{name}_us"]
            for way, latency in (("streamed", streamed), ("whole", whole))
            for name in ("p50", "p99", "p99_9", "max")
        }
        ratio = streamed["p50_us"] / whole["p50_us"]
        rows.append(
            Row(
                f"TV, {iterations} iterations",
                values | {"ratio of p50": ratio},
                f"<= {LIMIT}",
                ratio <= LIMIT,
            )
        )
    note = json.dumps({"frames": FRAMES, "rate_hz": RATE_HZ})
    return [Table("realtime", "From the last row to the slopes, us", rows, [note])]
