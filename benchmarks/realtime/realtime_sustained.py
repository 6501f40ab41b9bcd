"""Does the engine keep up, for minutes, and do loop and memory stay as they are for a million frames?

Engine and camera run as processes of their own. Frames that are lost are told beside how often the scheduler
took the processor away from engine and camera; on a machine that others use, that explains them or does not.
Then both have real-time priority while another program keeps each processor busy: threads that sleep until
rows are due, and threads that poll.

A simulated telescope of 36 sub-apertures closes the loop for a million frames (FAINTSPOT_SUSTAINED_FRAMES).
It has real-time priority, too; late frames delay the turbulence. Every second the engine is asked whether the
loop is closed. Late frames of the telescope itself, and frame times in which it had none, are told apart from
the engine's. FAINTSPOT_SUSTAINED_HZ is its frame rate (500).
FAINTSPOT_SUSTAINED_S sets how long each of the other runs takes, by default 300 s.
"""

import os
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np

from benchmarks.measuring import Row, Table
from benchmarks.realtime.realtime_processes import (
    SMALL,
    USUAL,
    engine_and_camera,
    engine_and_telescope,
    involuntary_switches,
    resident_bytes,
)
from faintspot import Settings
from faintspot.engine.control.control_loop import CLOSED
from faintspot.engine.processes.requests import TELESCOPE, request, socket_path
from faintspot.loop.simulation import LoopConfiguration, Method, load_loop
from faintspot.loop.simulation.engine_files import write_engine_files
from faintspot.slopes.pipeline import configuration as configuration_file

SECONDS = float(os.environ.get("FAINTSPOT_SUSTAINED_S", "300"))
LARGE = {"across": 40, "pixels": 8, "outer_radius": 19.9, "inner_radius": 3.4}
"""1208 sub-apertures of 8 x 8 pixels."""
LONG_FRAMES = int(os.environ.get("FAINTSPOT_SUSTAINED_FRAMES", "1000000"))
LONG_RATE_HZ = float(os.environ.get("FAINTSPOT_SUSTAINED_HZ", "500"))
BUSY_RATE_HZ, BUSY_PRIORITY, MOST_LATE = 300, 80, 1e-3
_STREHL = 1
"""Place of the Strehl ratio in `faintspot.engine.telescope.TRUTH`."""


def _sustained(name: str, values: dict[str, Any], rate_hz: int) -> Row:
    """Run for SECONDS and count."""
    camera = ["--frame-rate-hz", str(rate_hz), "--rows-per-block", "8"]
    with engine_and_camera({**values, **USUAL}, camera) as processes:
        first = processes.until_processed(rate_hz // 2)["counters"]
        pids = processes.engine.pid, processes.camera.pid
        switches = [involuntary_switches(pid) for pid in pids]
        time.sleep(SECONDS)
        last = processes.status()
        switches = [involuntary_switches(pid) - before for pid, before in zip(pids, switches, strict=True)]
    counters, latency = last["counters"], last["latency"]
    lost = counters["dropped"] - first["dropped"]
    columns = {
        "frames/s": (counters["processed"] - first["processed"]) / SECONDS,
        "measured": counters["processed"] - first["processed"],
        "lost": lost,
        "late (1 ms)": counters["late"] - first["late"],
        "p50 us": latency["p50_us"],
        "p99 us": latency["p99_us"],
        "p99.9 us": latency["p99_9_us"],
        "max us": latency["max_us"],
        "engine switched out": switches[0],
        "camera switched out": switches[1],
    }
    return Row(f"{name}, {rate_hz} frames/s", columns, "0 lost, or switched out", lost <= sum(switches))


def _beside_others(title: str, *options: str) -> Row:
    """Run with real-time priority while another program keeps each processor busy."""
    camera = ["--frame-rate-hz", str(BUSY_RATE_HZ)]
    with (
        engine_and_camera({**SMALL, **USUAL}, camera, options, BUSY_PRIORITY) as processes,
        ExitStack() as others,
    ):
        processes.until_processed(BUSY_RATE_HZ)
        for _ in range(os.cpu_count() or 1):
            other = subprocess.Popen([sys.executable, "-c", "while True: pass"])
            others.callback(other.wait)
            others.callback(other.terminate)
        first = processes.status()
        time.sleep(SECONDS)
        last = processes.status()
    changes = {name: last["counters"][name] - value for name, value in first["counters"].items()}
    late = changes["late"] / changes["processed"]
    columns = {
        "measured": changes["processed"],
        "lost": changes["dropped"],
        "late (1 ms), %": 100 * late,
        **{f"{name} us": last["latency"][f"{name}_us"] for name in ("p50", "p99", "p99_9", "max")},
        **{f"late: {cause}": count for cause, count in last["late_because"].items()},
        **{f"lost: {cause}": count for cause, count in last["lost_because"].items()},
    }
    return Row(
        title, columns, f"<= {100 * MOST_LATE} % late, 0 lost", late <= MOST_LATE and not changes["dropped"]
    )


def _small_telescope() -> LoopConfiguration:
    """Return a telescope that is simulated in half a millisecond a frame."""
    configuration = load_loop("diffraction_limit").replace("sensor", pixels=8, samples=6)
    one_layer: dict[str, Any] = {"altitude_m": (0.0,), "fraction": (1.0,)}
    one_layer |= {"wind_speed_m_per_s": (9.0,), "wind_direction_deg": (20.0,)}
    return configuration.replace("atmosphere", **one_layer).slowed_to(LONG_RATE_HZ)


def _long() -> Row:
    """Close the loop for a million frames; count looks at it and lost frames, and compare memory."""
    import pyshmem

    configuration = _small_telescope()
    name = f"faintspot_benchmark_{uuid4().hex[:8]}"
    method = Method("brightest pixels", Settings("brightest", keep_brightest=12), 0.3)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        (folder / "loop.toml").write_text(configuration.to_text(), encoding="utf-8")
        configuration_file.save(folder / "faintspot.toml", method.settings)
        path = write_engine_files(configuration.replace("control", gain=method.gain), folder, method.control)
        looks = []
        with engine_and_telescope(name, path, folder / "loop.toml", (), BUSY_PRIORITY) as (processes, _):
            first = processes.until_processed(LONG_FRAMES // 100)
            telescope = request(socket_path(name, TELESCOPE), "status")
            before, begun = resident_bytes(processes.engine.pid), time.monotonic()
            truth = pyshmem.open(f"{name}_truth")
            while (last := processes.status())["counters"]["processed"] < LONG_FRAMES:
                looks.append((last["loop"]["state"] == CLOSED, truth.read()[_STREHL]))
                time.sleep(1.0)
            seen = request(socket_path(name, TELESCOPE), "status")
            seconds, grown = time.monotonic() - begun, resident_bytes(processes.engine.pid) - before
    changes = {key: last["counters"][key] - value for key, value in first["counters"].items()}
    closed, strehl = np.array(looks, np.float64).T
    columns = {
        "measured": last["counters"]["processed"],
        "frames/s": changes["processed"] / seconds,
        "lost, %": 100 * changes["dropped"] / changes["frames_in"],
        **{f"lost: {cause}": count for cause, count in last["lost_because"].items()},
        "passed over": changes["passed_over"],
        "late (1 ms), %": 100 * changes["late"] / changes["processed"],
        **{f"late: {cause}": count for cause, count in last["late_because"].items()},
        "telescope late": seen["late"] - telescope["late"],
        "telescope without a frame": seen["overruns"] - telescope["overruns"],
        "looks": len(looks),
        "open": float(np.sum(closed == 0)),
        "Strehl, first half": float(strehl[: len(looks) // 2].mean()),
        "second half": float(strehl[len(looks) // 2 :].mean()),
        **{f"{key} us": last["latency"][f"{key}_us"] for key in ("p50", "p99", "p99_9", "max")},
        "memory grown, kB": grown / 1024,
    }
    met = grown < 1e6 and bool(closed.all())
    return Row(f"{LONG_FRAMES} frames of a closed loop, 36 x 8x8", columns, "always closed, < 1 MB", met)


def run() -> list[Table]:
    """Run both sensors, and the long one."""
    rows = [_sustained("36 x 16x16", SMALL, 1000), _sustained("1208 x 8x8", LARGE, 300)]
    return [
        Table("realtime-sustained", f"For {SECONDS:.0f} s, TV with 10 iterations", rows),
        Table(
            "realtime-busy",
            f"Beside a busy program on each processor, {BUSY_RATE_HZ} frames/s, priority {BUSY_PRIORITY}",
            [_beside_others("sleeping until rows are due"), _beside_others("polling", "--poll")],
        ),
        Table("realtime-long", "A closed loop", [_long()]),
    ]
