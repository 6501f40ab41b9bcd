"""Does the engine keep up, for minutes, and does its memory stay the same for a million frames?

Engine and camera run as processes of their own. Frames that are lost are told beside how often the scheduler
took the processor away from engine and camera; on a machine that others use, that explains them or does not.
Then both have real-time priority while another program keeps each processor busy: threads that sleep until
rows are due, and threads that poll.
FAINTSPOT_SUSTAINED_S sets how long each run takes, by default 300 s.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from contextlib import ExitStack
from typing import Any

from benchmarks.measuring import Row, Table
from benchmarks.realtime_processes import (
    SMALL,
    USUAL,
    engine_and_camera,
    involuntary_switches,
    resident_bytes,
)

SECONDS = float(os.environ.get("FAINTSPOT_SUSTAINED_S", "300"))
LARGE = {"across": 40, "pixels": 8, "outer_radius": 19.9, "inner_radius": 3.4}
"""1208 sub-apertures of 8 x 8 pixels."""
LONG_FRAMES, LONG_RATE_HZ = 1_000_000, 10_000
BUSY_RATE_HZ, BUSY_PRIORITY, MOST_LATE = 300, 80, 1e-3
_TINY = {"across": 3, "pixels": 4, "outer_radius": 9, "inner_radius": 0}


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
        **last["late_because"],
    }
    return Row(
        title, columns, f"<= {100 * MOST_LATE} % late, 0 lost", late <= MOST_LATE and not changes["dropped"]
    )


def _long() -> Row:
    """Measure a million frames of a small sensor and compare memory."""
    with engine_and_camera(
        {**_TINY, **USUAL, "iterations": 2}, ["--frame-rate-hz", str(LONG_RATE_HZ)]
    ) as processes:
        processes.until_processed(LONG_FRAMES // 100)
        before = resident_bytes(processes.engine.pid)
        while (counters := processes.status()["counters"])["processed"] < LONG_FRAMES:
            time.sleep(1.0)
        grown = resident_bytes(processes.engine.pid) - before
    columns = {
        "measured": counters["processed"],
        "lost": counters["dropped"],
        "memory grown, kB": grown / 1024,
    }
    return Row(f"{LONG_FRAMES} frames of 9 x 4x4 pixels", columns, "< 1 MB", grown < 1e6)


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
        Table("realtime-long", "Constant memory", [_long()]),
    ]
