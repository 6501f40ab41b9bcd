"""faintspot against pyRTC's Shack-Hartmann slopes, on the same frames, 36 sub-apertures of 16 x 16 pixels.

A square of 6 x 6, because pyRTC measures every sub-aperture of a square and leaves out some afterwards.
Frames are whole ADU: spots of 300 e-, 2 e- of read noise, a level of 100 ADU. pyRTC gets them as its own
camera component publishes them, int32 with the level taken off; faintspot gets raw uint16 and takes it off.

pyRTC measures with `centroider: cog`, contrast 0: pixels below 0 count as 0. faintspot measures with the same
estimator (`thresholded` at 0 e-: the positions agree), with the 12 brightest pixels, and with ten TV
iterations; its time includes dark, bad and saturated pixels, standard errors and flags, pyRTC's does not.

- Functions alone, one thread, candidates in turn. pyRTC: its compiled function, called as its `SlopesProcess`
  calls it; and what `SlopesProcess` does with a frame in all, which adds gathering the valid slopes and their
  two-dimensional map. faintspot: the compiled code (a frame's part of a call with 64 frames), the offline
  pipeline called with one frame, and the real-time path called for one frame whose rows are all there.
- Stream to stream: a frame is published in a pyshmem stream (with `notify`, as pyRTC's are), the slopes come
  out in another; the time is between the stamps of the two publications (`write_time`). pyRTC: one process,
  `SlopesProcess` with its worker thread. faintspot: one process, `faintspot realtime run --stream`. 300
  frames/s, blocks of frames in turn; the engine is halted (SIGSTOP) while pyRTC has its turn.
"""

import importlib.util
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray

import faintspot as fs
from benchmarks.measuring import (
    Candidate,
    Row,
    Table,
    Times,
    best,
    interleaved,
    median_ratio,
    pinned,
    ratio,
    spread,
)
from faintspot.engine.frames.frame_path import FramePath, Progress
from faintspot.engine.processes.requests import request, socket_path

SIDE, PIXELS, LEVEL_ADU, RATE_HZ = 6, 16, 100, 300.0
ROUNDS, FRAMES_A_ROUND, BATCH = 8, 300, 64
SAME_POSITION_PX = 1e-4
"""Same algorithm: only float32 rounding may differ."""
METHODS: dict[str, tuple[dict[str, Any], float | None]] = {
    "plain": ({"estimator": "thresholded", "threshold_e": 0.0}, 1.0),
    "12 brightest": ({"estimator": "brightest", "keep_brightest": 12}, None),
    "TV, 10 iterations": (
        {
            "estimator": "tv",
            "noise_std": 2.0,
            "tolerance": 0.0,
            "max_iterations": 10,
            "keep_brightest": 12,
        },
        3.0,
    ),
}
"""Settings, and the largest allowed ratio to pyRTC's time."""
CONFIGURATION = f"""
[layout.grid]
shape = [{SIDE}, {SIDE}]
pixels = {PIXELS}

[estimator]
name = "thresholded"
threshold_e = 0.0

[calibration]
dark = {LEVEL_ADU}
read_noise_e = 2.0
"""
_PATIENCE_S = 120.0
MISSING = "pyrtcao and pyshmem are not installed: nothing to compare with"


def frames(count: int = 8) -> tuple[fs.Layout, NDArray[np.uint16]]:
    """Simulate raw frames."""
    layout = fs.Layout.grid((SIDE, SIDE), pixels=PIXELS)
    detector = fs.slopes.simulate.Detector(2.0, offset_adu=LEVEL_ADU, bits=16)
    raw, _ = fs.slopes.simulate.sensor_frames(
        layout,
        count,
        flux_e=300.0,
        detector=detector,
        rng=np.random.default_rng(1),
    )
    return layout, raw


def pipeline_of(layout: fs.Layout, settings: dict[str, Any]) -> fs.SlopePipeline:
    """Return the pipeline that takes the level off."""
    calibration = fs.Calibration(dark=float(LEVEL_ADU), read_noise_e=2.0)
    return fs.SlopePipeline(layout, fs.Settings(**settings), calibration, threads=1)


def slopes_process(name: str, functions: list[str], pixels: int = PIXELS) -> Any:
    """Make pyRTC's component between the streams NAME_wfs and NAME_signal; it compiles on the way."""
    from pyrtc import SlopesProcess, configure_logging  # type: ignore[import-untyped, unused-ignore]

    configure_logging(level="WARNING")
    streams = {stream: f"{name}_{stream}" for stream in ("signal", "signal_2d")}
    return SlopesProcess(
        {
            "type": "SHWFS",
            "signal_type": "slopes",
            "centroider": "cog",
            "sub_ap_spacing": pixels,
            "sub_ap_offset_x": 0,
            "sub_ap_offset_y": 0,
            "functions": functions,
            "input_streams": {"wfs": f"{name}_wfs"},
            "output_streams": streams,
        }
    )


@contextmanager
def streams_in(name: str, shape: tuple[int, int]) -> Iterator[tuple[Any, Any]]:
    """Make the streams NAME_wfs and NAME_wfs_raw; remove them and those that pyRTC makes."""
    from pyrtc import clear_shms, create_stream

    try:
        yield (
            create_stream(f"{name}_wfs", shape, np.int32),
            create_stream(f"{name}_wfs_raw", shape, np.uint16),
        )
    finally:
        clear_shms([f"{name}_{stream}" for stream in ("wfs", "wfs_raw", "signal", "signal_2d")])


def end_processes(processes: list[subprocess.Popen[bytes]]) -> None:
    """End processes, also halted ones."""
    for process in processes:
        process.send_signal(signal.SIGCONT)
        process.terminate()
    for process in processes:
        try:
            process.wait(10.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def pyrtc_kernel(component: Any, image: NDArray[np.int32], pixels: int = PIXELS) -> Candidate:
    """Return a call of pyRTC's compiled function, with the component's own arguments."""
    from pyrtc import slopes_process  # type: ignore[import-untyped, unused-ignore]

    slopes = np.zeros_like(component.ref_slopes)
    arguments = {
        "image": image,
        "slopes": slopes,
        "unaberrated_slopes": component.ref_slopes,
        "threshold": np.float32(0.0),
        "spacing": np.float32(pixels),
        "xvals": component.xvals,
        "offset_x": 0,
        "offset_y": 0,
        "int_n": pixels,
    }
    return partial(slopes_process.compute_slopes_shwfs_optim_numba, **arguments)


def path_of(pipeline: fs.SlopePipeline, raw: NDArray[np.uint16]) -> FramePath:
    """Return a frame path for one frame whose rows are all there."""
    path = FramePath(pipeline, [raw], Progress(np.array([0, len(raw)], np.int64), 0, 1))
    path.warm_up()
    return path


def difference_px(component: Any, layout: fs.Layout, raw: NDArray[np.uint16]) -> float:
    """Return by how much pyRTC's and faintspot's plain positions differ at most."""
    theirs = pyrtc_kernel(component, raw.astype(np.int32) - LEVEL_ADU)().reshape(2, -1)
    ours = pipeline_of(layout, METHODS["plain"][0])(raw)
    return float(np.abs(theirs - np.stack([ours.x, ours.y])).max())


def _alone() -> Table:
    """Compare the functions themselves."""
    layout, stack = frames()
    raw, name = stack[0], f"faintspot_benchmark_{uuid4().hex[:8]}"
    batch = np.repeat(raw[None], BATCH, axis=0)
    with streams_in(name, layout.frame_shape):
        component = slopes_process(name, [])
        image = raw.astype(np.int32) - LEVEL_ADU
        difference = difference_px(component, layout, raw)
        candidates: dict[str, Candidate] = {
            "pyRTC": pyrtc_kernel(component, image),
            "pyRTC, with map": partial(component._process_image, image),
        }
        for method, (settings, _) in METHODS.items():
            pipeline = pipeline_of(layout, settings)
            candidates[f"compiled code, {method}"] = partial(pipeline, batch)
            candidates[f"offline call, {method}"] = partial(pipeline, raw)
            candidates[f"real-time call, {method}"] = partial(path_of(pipeline, raw).measure, 0)
        with pinned():
            times = interleaved(candidates, seconds=10.0)
        component.close()
    for method in METHODS:
        times[f"compiled code, {method}"] /= BATCH
    targets = {f"compiled code, {method}": limit for method, (_, limit) in METHODS.items()}
    rows = []
    for candidate in candidates:
        found = ratio(times, candidate, "pyRTC", ("ratio", "median ratio"))
        values = {"us": best(times, candidate) * 1e6, **found.values}
        known = {} if candidate == "pyRTC" else found.spread
        rows.append(_row(candidate, values, targets.get(candidate), found.larger, known))
    note = f"plain positions differ by at most {difference:.1e} px (allowed: {SAME_POSITION_PX:.0e})"
    title = "pyRTC's centre of gravity and faintspot, one frame, one thread"
    return Table("pyrtc", title, rows, [note])


def _row(
    name: str, values: dict[str, float], limit: float | None, ratio: float, known: dict[str, float]
) -> Row:
    """Return a line with its target, where there is one; `known` is its spread."""
    if limit is None:
        return Row(name, values, spread=known, better="lower")
    return Row(name, values, f"<= {limit:g}", ratio <= limit, known)


class _Systems:
    """Both systems running, each to be fed by `latencies_us`."""

    def __init__(self, name: str, folder: str, theirs: Any, ours: Any, stack: NDArray[np.uint16]) -> None:
        (Path(folder) / "faintspot.toml").write_text(CONFIGURATION)
        command = [sys.executable, "-m", "faintspot", "realtime"]
        self._started = [
            subprocess.Popen(arguments, cwd=where, stdout=subprocess.DEVNULL)
            for arguments, where in (
                ([*command, "run", "--stream", f"{name}_wfs_raw", "--name", name], folder),
                ([sys.executable, "-m", "benchmarks.realtime.pyrtc", name], None),
            )
        ]
        self._engine, self._name, self._number = self._started[0], name, 1
        self._frames: dict[str, NDArray[Any]] = {
            "pyRTC": stack.astype(np.int32) - LEVEL_ADU,
            "faintspot": stack,
        }
        self._into = {"pyRTC": theirs, "faintspot": ours}
        self._out_names = {"pyRTC": f"{name}_signal", "faintspot": f"{name}_slopes"}
        self._out: dict[str, Any] = {}

    def wait(self) -> None:
        """Wait until both measure; they may have to compile."""
        import pyshmem

        end = time.monotonic() + _PATIENCE_S
        for system, out in self._out_names.items():
            while system not in self._out:
                time.sleep(0.1)
                try:
                    self._out[system] = pyshmem.open(out, readonly=True)
                except FileNotFoundError:
                    if time.monotonic() > end:
                        raise
            while not self.latencies_us(system, 30) and time.monotonic() < end:
                pass

    def set(self, settings: dict[str, Any]) -> None:
        """Change the engine's settings."""
        request(socket_path(self._name), "set", changes=settings)

    def halt(self, halted: bool) -> None:
        """Halt the engine, or let it go on."""
        self._engine.send_signal(signal.SIGSTOP if halted else signal.SIGCONT)

    def latencies_us(self, system: str, count: int) -> list[float]:
        """Publish frames at the rate; return the time to the slopes of each whose slopes came in time."""
        into, out, stack = self._into[system], self._out[system], self._frames[system]
        found, start = [], time.monotonic() + 0.01
        for tick in range(count):
            time.sleep(max(0.0, start + tick / RATE_HZ - time.monotonic()))
            into.write(stack[tick % len(stack)], frame_id=self._number)
            sent = into.write_time
            time.sleep(0.8 / RATE_HZ)
            publication = out.read_publication() if out.count else None
            if publication is not None and publication.frame_id == self._number:
                found.append((publication.write_time - sent) * 1e6)
            self._number += 1
        return found

    def end(self) -> None:
        """End all processes."""
        end_processes(self._started)


def _spread_of_rounds(rounds: Times, method: str) -> float:
    return spread(rounds, lambda part: median_ratio(part, method, "pyRTC"))


def _streams() -> Table:
    """Compare both systems, from stream to stream."""
    layout, stack = frames()
    name = f"faintspot_benchmark_{uuid4().hex[:8]}"
    methods = ["pyRTC", *METHODS]
    collected: dict[str, list[list[float]]] = {method: [] for method in methods}
    with tempfile.TemporaryDirectory() as folder, streams_in(name, layout.frame_shape) as (theirs, ours):
        systems = _Systems(name, folder, theirs, ours, stack)
        try:
            systems.wait()
            for _ in range(ROUNDS):
                for method in methods:
                    own = method != "pyRTC"
                    systems.halt(not own)
                    if own:
                        systems.set(METHODS[method][0])
                    system = "faintspot" if own else "pyRTC"
                    systems.latencies_us(system, 10)  # settle
                    collected[method].append(systems.latencies_us(system, FRAMES_A_ROUND))
        finally:
            systems.end()
    rows = []
    rounds = {method: np.array([np.median(part) for part in parts]) for method, parts in collected.items()}
    for method, parts in collected.items():
        whole = np.concatenate(parts)
        p50, p99, p99_9 = np.percentile(whole, [50, 99, 99.9])
        middle = median_ratio(rounds, method, "pyRTC")
        missing = ROUNDS * FRAMES_A_ROUND - len(whole)
        values = {
            "p50": p50,
            "p99": p99,
            "p99.9": p99_9,
            "ratio of p50": middle,
            "not in time": float(missing),
        }
        limit = METHODS[method][1] if method in METHODS else None
        name = method if method == "pyRTC" else f"faintspot, {method}"
        known = {} if method == "pyRTC" else {"ratio of p50": _spread_of_rounds(rounds, method)}
        rows.append(_row(name, values, limit, middle, known))
    note = f"{ROUNDS} rounds of {FRAMES_A_ROUND} frames at {RATE_HZ:g}/s; {os.cpu_count()} processors"
    return Table("pyrtc_streams", "From the frame's stream to the slopes' stream, us", rows, [note])


def run() -> list[Table]:
    """Compare, where pyRTC is installed."""
    if not all(importlib.util.find_spec(package) for package in ("pyrtc", "pyshmem")):
        return [Table("pyrtc", "pyRTC", [], [MISSING])]
    return [_alone(), _streams()]


if __name__ == "__main__":
    slopes_process(sys.argv[1], ["compute_signal"]).start()
    signal.pause()
