"""How long after its last row are a frame's slopes there?

The engine and a simulated camera run as processes of their own, 36 sub-apertures of 16 x 16 pixels at 300
frames/s. Streamed: the camera publishes four rows at a time, at the pace of a read-out that takes 80 % of the
frame time. Whole: the same frames, published in one piece. The time is from the last row's arrival to the
publication of the last slope, as the engine itself measures it; two processors at least should be free.

What the engine adds to the compiled work is measured in one thread, with frames that are there: all that its
thread does with one, publishing and telemetry included, less the call that measures it.

The limit of iterations is tried on frames that converge slowly: strength near the images' own deviation.

From the last row to the command: see frame_to_command.py.
"""

import time
from typing import Any
from uuid import uuid4

import numpy as np

from benchmarks.measuring import Row, Table, Times, median_ratio, spread
from benchmarks.realtime.frame_to_command import command_table
from benchmarks.realtime.realtime_processes import SMALL, USUAL, engine_and_camera
from faintspot import Calibration, Layout, Settings, SlopePipeline
from faintspot.engine.engine import Engine
from faintspot.engine.frames.pixel_ring import PixelRing
from faintspot.engine.settings.plan import EngineOptions

FRAMES, RATE_HZ, ROWS = 1500, 300, 112
ROUNDS = 3
ITERATIONS = (10, 20)
LIMIT, OVERHEAD_US = 0.3, 15.0
_NAMES = ("p50", "p99", "p99_9", "max")
_SLOW = {"noise_std": 1.15, "tolerance": 1e-6}


def _latency(values: dict[str, Any], rows_per_block: int, flux_e: float = 200.0) -> dict[str, float]:
    """Return the engine's latencies over FRAMES frames, us."""
    camera = ["--frame-rate-hz", str(RATE_HZ), "--rows-per-block", str(rows_per_block)]
    with engine_and_camera({**SMALL, **USUAL, **values}, camera, flux_e=flux_e) as processes:
        status = processes.until_processed(FRAMES)
    return {name: status["latency"][f"{name}_us"] for name in _NAMES}


def _own_us(iterations: int) -> dict[str, float]:
    """Return how long the engine's thread takes for a frame that is there, and the compiled part of it."""
    name = f"faintspot_benchmark_{uuid4().hex[:8]}"
    layout = Layout.grid((7, 7), pixels=16, outer_radius=3.5, inner_radius=0.5)
    settings = Settings(noise_std=1.0, keep_brightest=12, tolerance=0.0, max_iterations=iterations)
    rng = np.random.default_rng(1)
    frame = rng.poisson(1.0, layout.frame_shape).astype(np.float32)
    times = np.zeros((2, FRAMES))
    with PixelRing.create(name, layout.frame_shape, np.float32) as ring:
        engine = Engine(
            name,
            lambda each: SlopePipeline(layout, each, Calibration(dark=0.0, read_noise_e=1.0)),
            settings,
            EngineOptions(images_every=0),
        )
        path = engine.live.running.paths(ring)[0]
        with engine._streams.held():
            for index in range(FRAMES):
                ring.publish(frame)
                start = time.perf_counter_ns()
                engine._measure_next(ring)
                middle = time.perf_counter_ns()
                path.measure(index + 1, index % ring.slots)
                times[:, index] = middle - start, time.perf_counter_ns() - middle
        engine._streams.close()
        engine._telemetry.close()
    whole, compiled = np.median(times, axis=1) / 1e3
    return {"whole": float(whole), "compiled, and its call": float(compiled), "adds": float(whole - compiled)}


def _streamed_to_whole(p50: Times) -> float:
    return median_ratio(p50, "streamed", "whole")


def _streaming() -> Table:
    rows = []
    for iterations in ITERATIONS:
        values = {"iterations": iterations}
        rounds: dict[str, list[dict[str, float]]] = {"streamed": [], "whole": []}
        for _ in range(ROUNDS):
            rounds["streamed"].append(_latency(values, 4))
            rounds["whole"].append(_latency(values, ROWS))
        columns = {
            f"{method} {name}": float(np.median([each[name] for each in found]))
            for method, found in rounds.items()
            for name in _NAMES
        }
        p50 = {method: np.array([each["p50"] for each in found]) for method, found in rounds.items()}
        ratio = columns["ratio of p50"] = _streamed_to_whole(p50)
        known = {"ratio of p50": spread(p50, _streamed_to_whole)}
        rows.append(Row(f"TV, {iterations} iterations", columns, f"<= {LIMIT}", ratio <= LIMIT, known))
    note = f"{ROUNDS} rounds of {FRAMES} frames at {RATE_HZ} frames/s, medians of the rounds; us"
    return Table("realtime", "From the last row to the slopes, us", rows, [note])


def _own() -> Table:
    rows = []
    for iterations in ITERATIONS:
        columns = _own_us(iterations)
        added = columns["adds"]
        rows.append(
            Row(f"TV, {iterations} iterations", columns, f"<= {OVERHEAD_US} us", added <= OVERHEAD_US)
        )
    return Table("realtime-own", "What the engine's thread does with a frame, us at p50", rows)


def _tail() -> Table:
    rows = []
    for limit in (10, 40, 2000):
        latency = _latency({**_SLOW, "iterations": limit}, 4, flux_e=20.0)
        rows.append(
            Row(f"at most {limit} iterations", latency | {"max/p50": latency["max"] / latency["p50"]})
        )
    note = f"noise_std = {_SLOW['noise_std']} at 20 e- and 1 e-, tolerance {_SLOW['tolerance']}"
    return Table("realtime-tail", "Frames that converge slowly: the limit bounds the tail, us", rows, [note])


def run() -> list[Table]:
    """Measure streamed and whole frames, the limit of iterations, and the way to commands."""
    return [_streaming(), _own(), _tail(), command_table()]
