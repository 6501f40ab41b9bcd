"""From frame to command: pyRTC's full loop and faintspot's, on the same frames, in one run.

36 sub-apertures of 16 x 16 pixels, an integrator with the same reconstructor (72 slopes, 54 commands), gain
and leak (the frames do not answer the commands; the leak keeps these in bounds). Frames as in `python -m
benchmarks pyrtc`. The time is from the publication of the frame to that of the commands (between the stamps
of both), and to that of the slopes; 300 frames/s, blocks of frames in turn. All have the same real-time
priority, where that is permitted: on a busy machine the scheduler would be compared else. Of a processor
that is kept busy so, the kernel takes a part of each second away for others, and frames of that time are
late.

- pyRTC: `SlopesProcess` (centre of gravity) and `Loop` (`leaky_integrator`, the compiled function of its
  standard one), each with its worker thread, joined by streams with `notify`. Both ways that it documents:
  "soft-rtc", threads of one process, with which one is to begin, and "hard-rtc", a process each, the faster
  one. Frames are published as its camera component does, int32 without the level.
- faintspot: one process. Whole frames from a stream like pyRTC's (`realtime run --stream`), or rows from
  the pixel ring, read out over `READOUT_S`; then the time is from the last row. Raw uint16. The engine that
  has not its turn is halted (SIGSTOP); pyRTC's components sleep.

The plain centre of gravity makes the same commands as pyRTC's: by how much they differ is said.
"""

import importlib.util
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray

from benchmarks.measuring import Row, Table, Times, median_ratio, spread
from benchmarks.realtime import pyrtc
from benchmarks.realtime.pyrtc import LEVEL_ADU, PIXELS, RATE_HZ, SIDE
from faintspot.engine.frames.pixel_ring import PixelRing
from faintspot.engine.processes.requests import LENGTHY_TIMEOUT_S, request, socket_path
from faintspot.loop.control.configuration import Control

COMMANDS, GAIN, LEAK = 54, 0.4, 0.1
ROUNDS, FRAMES_A_ROUND, SETTLE, READOUT_S = 8, 250, 10, 1e-3
SOFT, HARD, STREAM, ROWS = "pyRTC, soft-rtc", "pyRTC, hard-rtc", "stream", "rows"
METHODS: dict[str, dict[str, Any]] = {
    **{method: settings for method, (settings, _) in pyrtc.METHODS.items()},
    "window": {"estimator": "window", "window_fwhm_px": 4.0, "normalisation": "frame"},
}
PLAIN = "plain"
_PATIENCE_S, _MOST_LATE = 120.0, 0.5
_CONFIGURATION = f"""{pyrtc.CONFIGURATION}
[psf]
profile = "diffraction"

[control]
interaction_matrix = "interaction.npy"
gain = {GAIN}
leak = {LEAK}
"""
_FIRST = ["chrt", "--fifo"]
_PRIORITY = "50"
"""Real-time priority for all of them, where it is permitted."""
Send = Callable[[int, int], float]


def interaction() -> NDArray[np.float64]:
    """Return an interaction matrix."""
    return np.random.default_rng(1).standard_normal((2 * SIDE * SIDE, COMMANDS))


@dataclass
class System:
    """One of those that are compared, while it runs.

    Parameters
    ----------
    send : function (index into the frames, frame number)
        Publishes a frame; returns when its last row was there, s since the epoch.
    slopes, commands : str
        Streams.
    engine : process, optional
        To be halted.
    control : str
        Name of its control channel.
    """

    send: Send
    slopes: str
    commands: str
    engine: subprocess.Popen[bytes] | None = None
    control: str = ""
    _out: list[Any] = field(default_factory=list)
    _number: int = 0

    def wait(self) -> None:
        """Wait until it makes commands; it may have to compile."""
        import pyshmem

        end = time.monotonic() + _PATIENCE_S
        while len(self._out) < 2:
            time.sleep(0.1)
            try:
                self._out = [pyshmem.open(name, readonly=True) for name in (self.slopes, self.commands)]
            except FileNotFoundError:
                if time.monotonic() > end:
                    raise
        while np.isnan(self.latencies_us(30)[:, 1]).mean() > _MOST_LATE:
            if time.monotonic() > end:
                raise TimeoutError(f"{self.commands}: commands are late")

    def halt(self, halted: bool) -> None:
        """Halt its engine, or let it go on."""
        if self.engine is not None:
            self.engine.send_signal(signal.SIGSTOP if halted else signal.SIGCONT)

    def choose(self, method: str) -> None:
        """Set its engine to one of METHODS."""
        request(socket_path(self.control), "set", timeout_s=LENGTHY_TIMEOUT_S, changes=METHODS[method])

    def latencies_us(self, count: int) -> NDArray[np.float64]:
        """Publish frames at the rate; return times to slopes and commands, (count, 2), NaN if not in time."""
        found = np.full((count, 2), np.nan)
        start = time.monotonic() + 0.01
        for tick in range(count):
            time.sleep(max(0.0, start + tick / RATE_HZ - time.monotonic()))
            self._number += 1
            sent = self.send(tick, self._number)
            time.sleep(0.6 / RATE_HZ)
            for place, stream in enumerate(self._out):
                publication = stream.read_publication() if stream.count else None
                if publication is not None and publication.frame_id == self._number:
                    found[tick, place] = (publication.write_time - sent) * 1e6
        return found

    def last_commands(self) -> NDArray[np.float64]:
        """Return the newest."""
        return np.array(self._out[1].read(), np.float64).ravel()


def _into_stream(stream: Any, stack: NDArray[Any]) -> Send:
    """Return what publishes whole frames in a stream."""

    def send(index: int, number: int) -> float:
        stream.write(stack[index % len(stack)], frame_id=number)
        return float(stream.write_time)

    return send


def _into_ring(ring: PixelRing, stack: NDArray[Any]) -> Send:
    """Return what reads frames out by rows of sub-apertures."""

    def send(index: int, number: int) -> float:
        slot, frame, start = ring.begin(number), stack[index % len(stack)], time.monotonic()
        for block in range(1, SIDE + 1):
            rows = slice((block - 1) * PIXELS, block * PIXELS)
            time.sleep(max(0.0, start + block / SIDE * READOUT_S - time.monotonic()))
            slot[rows] = frame[rows]
            sent = time.time()
            ring.rows_ready(rows.stop)
        return sent

    return send


class _Bench:
    """All systems running on streams and rings of one name."""

    def __init__(self, name: str, folder: Path, streams: dict[str, tuple[Any, Any]], ring: PixelRing) -> None:
        layout, raw = pyrtc.frames()
        assert layout.frame_shape == ring.shape
        (folder / "faintspot.toml").write_text(_CONFIGURATION, encoding="utf-8")
        np.save(folder / "interaction.npy", interaction())
        plain = raw.astype(np.int32) - LEVEL_ADU
        self.processes: list[subprocess.Popen[bytes]] = []
        self.systems: dict[str, System] = {}
        for label, parts in ((SOFT, ["slopes,loop"]), (HARD, ["slopes", "loop"])):
            own, (into, _) = stream_name(name, label), streams[label]
            for part in parts:
                self._start(["benchmarks.realtime.pyrtc_loop", own, part], None)
            self.systems[label] = System(_into_stream(into, plain), f"{own}_signal", f"{own}_wfc")
        rings = stream_name(name, STREAM), ring.name
        sends = _into_stream(streams[STREAM][1], raw), _into_ring(ring, raw)
        for label, own, send in zip((STREAM, ROWS), rings, sends, strict=True):
            follow = ["--stream", f"{own}_wfs_raw"] if label == STREAM else []
            command = ["faintspot", "realtime", "run", "--name", own, "--close-loop", *follow]
            engine = self._start(command, folder)
            self.systems[label] = System(send, f"{own}_slopes", f"{own}_commands", engine, own)

    def _start(self, module: list[str], folder: Path | None) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", *module]
        process = subprocess.Popen(command, cwd=folder, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
        self.processes.append(process)
        return process

    def wait(self) -> None:
        """Wait for one after the other, until all have compiled; then give them priority."""
        for system in self.systems.values():
            system.wait()
            for method in METHODS if system.control else ():
                system.choose(method)
            system.halt(True)
        for process in self.processes if first() else ():
            subprocess.run([*_FIRST, "--all-tasks", "--pid", _PRIORITY, str(process.pid)], check=True)

    def end(self) -> None:
        """End all processes."""
        pyrtc.end_processes(self.processes)


@cache
def first() -> bool:
    """Whether real-time priority is permitted."""
    permitted = [*_FIRST, _PRIORITY, "true"]
    return shutil.which(_FIRST[0]) is not None and subprocess.run(permitted).returncode == 0


def stream_name(name: str, label: str) -> str:
    """Return the name of a system's streams."""
    return f"{name}_{label.split()[-1].replace('-', '_')}"


@contextmanager
def bench() -> Iterator[_Bench]:
    """Start all systems; end them, and remove what they leave."""
    from pyrtc import clear_shms, create_stream

    name, shape = f"faintspot_benchmark_{uuid4().hex[:8]}", (SIDE * PIXELS, SIDE * PIXELS)
    labels = (SOFT, HARD, STREAM)
    commands = [f"{stream_name(name, label)}_wfc" for label in (SOFT, HARD)]
    with (
        tempfile.TemporaryDirectory() as folder,
        pyrtc.streams_in(stream_name(name, SOFT), shape) as soft,
        pyrtc.streams_in(stream_name(name, HARD), shape) as hard,
        pyrtc.streams_in(stream_name(name, STREAM), shape) as own,
        PixelRing.create(stream_name(name, ROWS), shape, np.uint16) as ring,
    ):
        for each in commands:
            create_stream(each, (COMMANDS,), np.float32).write(np.zeros(COMMANDS, np.float32))
        running = _Bench(name, Path(folder), dict(zip(labels, (soft, hard, own), strict=True)), ring)
        try:
            running.wait()
            yield running
        finally:
            running.end()
            clear_shms(commands)


def measured() -> tuple[dict[str, NDArray[np.float64]], float]:
    """Return latencies, (rounds, frames, 2), by method, and how far plain commands differ, of the largest.

    After the best round: a frame that was lost moves them.
    """
    found: dict[str, list[NDArray[np.float64]]] = {}
    differences = []
    with bench() as running:
        for _ in range(ROUNDS):
            last = {}
            for label, system in running.systems.items():
                system.halt(False)
                for method in METHODS if system.control else ("",):
                    if method:
                        system.choose(method)
                    system.latencies_us(SETTLE)
                    name = f"faintspot, {method}, {label}" if method else label
                    found.setdefault(name, []).append(system.latencies_us(FRAMES_A_ROUND))
                    last[name] = system.last_commands()
                system.halt(True)
            theirs = last[HARD]
            ours = last[f"faintspot, {PLAIN}, {STREAM}"]
            differences.append(np.abs(ours - theirs).max() / np.abs(theirs).max())
    return {name: np.array(each) for name, each in found.items()}, min(differences)


def _spread_of_rounds(rounds: Times, name: str) -> float:
    return spread(rounds, lambda part: median_ratio(part, name, HARD))


def run() -> list[Table]:
    """Compare, where pyRTC is installed."""
    if not all(importlib.util.find_spec(package) for package in ("pyrtc", "pyshmem")):
        return [Table("pyrtc_loop", "pyRTC", [], [pyrtc.MISSING])]
    load = os.getloadavg()[0]
    found, difference = measured()
    rounds: Times = {name: np.nanmedian(each[..., 1], axis=1) for name, each in found.items()}
    rows = []
    for name, each in found.items():
        slopes, commands = (part[np.isfinite(part)] for part in (each[..., 0], each[..., 1]))
        middle = median_ratio(rounds, name, HARD)
        values = {
            "slopes p50": float(np.median(slopes)),
            "commands p50": float(np.median(commands)),
            "p99": float(np.percentile(commands, 99)),
            "max": float(commands.max()),
            "ratio of p50": middle,
            "not in time": float(each[..., 1].size - len(commands)),
        }
        known = {"ratio of p50": _spread_of_rounds(rounds, name)} if name != HARD else {}
        rows.append(Row(name, values, spread=known, better="lower"))
    notes = [
        f"{ROUNDS} rounds of {FRAMES_A_ROUND} frames at {RATE_HZ:g}/s; {os.cpu_count()} processors, load "
        f"average {load:.1f} before; real-time priority {'for all' if first() else 'is not permitted'}",
        f"after a round plain commands differ from pyRTC's by {difference:.1e} of the largest",
    ]
    return [Table("pyrtc_loop", "From frame to commands, us", rows, notes)]


def _loop(name: str) -> Any:
    """Make pyRTC's integrator between the streams NAME_signal and NAME_wfc."""
    from pyrtc import Loop, configure_logging, open_stream

    configure_logging(level="ERROR")  # a stream without frames is no surprise here
    end = time.monotonic() + _PATIENCE_S
    while time.monotonic() < end:  # pyRTC's other component makes it
        try:
            open_stream(f"{name}_signal")
            break
        except FileNotFoundError:
            time.sleep(0.1)
    loop = Loop(
        {
            "gain": GAIN,
            "leaky_gain": LEAK,
            "functions": ["leaky_integrator"],
            "input_streams": {"signal": f"{name}_signal"},
            "output_streams": {"wfc": f"{name}_wfc"},
        }
    )
    reconstructor = Control(interaction()).reconstructor.matrix  # damped; pyRTC inverts what it is given
    loop.im = np.linalg.pinv(reconstructor).astype(np.float32)
    loop.compute_cm()
    return loop


if __name__ == "__main__":
    own, parts = sys.argv[1], sys.argv[2].split(",")
    components = [
        pyrtc.slopes_process(own, ["compute_signal"]) if part == "slopes" else _loop(own) for part in parts
    ]
    for component in components:
        component.start()
    signal.pause()
