"""Frames in, slopes out between two streams of ImageStreamIO: a C program, and the engine.

A feeder in C publishes 36 x 16 x 16 pixels every millisecond, and reads the counter of the slopes' stream
all the time. The latency of a frame is from the stamp that the feeder takes just before it counts the frame
to its first look at which the slopes are counted: one clock, one process, and both programs seen from
outside. The feeder has a processor of its own, and what is measured has all others, at ordinary priority.
Where the feeder was away for more than `AWAY_US` before that look, the latency ends with the stamp in the
slopes' stream, which its writer takes just before it counts them. Those frames are counted.

The C program is examples/library/streams.c. The engine reads frames with `realtime run --stream`, and its
slopes become a stream of ImageStreamIO by `realtime bridge --to`: two processes, and two copies more. Its own
latencies, from the last row in its ring to its stream of slopes, are a row of their own.

FAINTSPOT_STREAMS_FRAMES is the number of frames (100,000); each of the three runs takes 1 ms a frame.
"""

import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray

import faintspot as fs
from benchmarks.measuring import Row, Table
from benchmarks.realtime.darc import DARK_ADU, KERNELS
from benchmarks.realtime.realtime_processes import CONFIGURATION, SMALL, USUAL
from faintspot.adapters.library.folder import export_library
from faintspot.adapters.library.objects import native_target
from faintspot.engine.processes.requests import request, socket_path
from faintspot.slopes.simulate import Detector, sensor_frames

FRAMES = int(os.environ.get("FAINTSPOT_STREAMS_FRAMES", "100000"))
AWAY_US = 10.0
_LEVELS = {
    "median us": (0.5, "p50_us"),
    "99 % us": (0.99, "p99_us"),
    "99.9 % us": (0.999, "p99_9_us"),
    "largest us": (1.0, "max_us"),
}
"""Columns: levels of the latencies, and their names in the engine's status."""
_HERE = Path(__file__).parent
_EXAMPLES = _HERE.parents[1] / "examples" / "library"
_SIMULATED, _FLUX_E = 100, 200.0


@contextmanager
def _started(
    command: Sequence[object], folder: Path, cpus: Sequence[int]
) -> Iterator[subprocess.Popen[bytes]]:
    """Start a program on these processors, with its streams in a folder; end it."""
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cpus)
    try:
        process = subprocess.Popen(
            [str(part) for part in command],
            stdout=subprocess.DEVNULL,
            env={**os.environ, "MILK_SHM_DIR": str(folder)},
        )
    finally:
        os.sched_setaffinity(0, allowed)
    try:
        yield process
    finally:
        process.terminate()
        process.wait()


def _prepared(folder: Path) -> tuple[Path, tuple[int, int]]:
    """Write configuration and frames, and build the programs; return the bundle and the frames' shape."""
    path = folder / "faintspot.toml"
    path.write_text(f"{CONFIGURATION.format(**SMALL, **USUAL)}dark = {DARK_ADU}\n", encoding="utf-8")
    pipeline, detector = fs.SlopePipeline.from_file(path), Detector(1.0, offset_adu=DARK_ADU, bits=16)
    layout, rng = pipeline.layout, np.random.default_rng(1)
    frames, _ = sensor_frames(layout, _SIMULATED, flux_e=_FLUX_E, detector=detector, rng=rng)
    frames.astype(np.uint16).tofile(folder / "frames.raw")
    bundle = export_library(pipeline, KERNELS.resolve(), "streams", cpus=[native_target()]).bundle
    library = bundle.parent
    compiler = ["cc", "-O2", f"-I{library}", f"-I{_EXAMPLES}"]
    link = [f"-L{library}", "-lfaintspot", f"-Wl,-rpath,{library}"]
    subprocess.run([*compiler, "-o", folder / "streams", _EXAMPLES / "streams.c", *link], check=True)
    subprocess.run([*compiler, "-o", folder / "feeder", _HERE / "stream_feeder.c"], check=True)
    return bundle, layout.frame_shape


def _row(name: str, times: NDArray[np.int64]) -> Row:
    """Return the latencies of a run."""
    sent, seen, stamp, away = times[times[:, 1] > 0].T
    was_away = away > 1e3 * AWAY_US
    latencies_us = (np.where(was_away, stamp, seen) - sent) / 1e3
    values = {key: float(np.quantile(latencies_us, level)) for key, (level, _) in _LEVELS.items()}
    values |= {"frames": len(times), "lost": len(times) - len(sent)}
    values["feeder away"] = int(np.sum(was_away))
    return Row(name, values, better="lower")


def _rows(folder: Path) -> Iterator[Row]:
    """Measure the C program that waits and the one that polls, and the engine."""
    (bundle, (height, width)), name = _prepared(folder), f"faintspot_benchmark_{uuid4().hex[:8]}"
    program: list[object] = [folder / "streams", bundle, "wfs", "slopes"]
    engine: list[object] = [sys.executable, "-m", "faintspot", "realtime"]
    run = [*engine, "run", "--config", folder / "faintspot.toml", "--stream", "isio:wfs", "--name", name]
    bridge = [*engine, "bridge", "--to", "isio:slopes", "--name", name]
    feeder = [folder / "feeder", "wfs", "slopes", folder / "frames.raw", width, height, FRAMES]
    first, *others = sorted(os.sched_getaffinity(0))
    commands = {
        "C program, waits": [program],
        "C program, polls": [[*program, "poll"]],
        "engine and bridge": [run, bridge],
    }
    for title, measured in commands.items():
        with ExitStack() as processes:
            fed = processes.enter_context(_started([*feeder, folder / "times"], folder, [first]))
            while fed.poll() is None and not (folder / "wfs.im.shm").exists():
                time.sleep(0.01)
            for command in measured:
                processes.enter_context(_started(command, folder, others))
            if fed.wait():
                raise RuntimeError(f"{title}: the feeder has seen no slopes")
            own = request(socket_path(name), "status") if run in measured else None
        (folder / "wfs.im.shm").unlink()
        yield _row(title, np.fromfile(folder / "times", np.int64).reshape(-1, 4))
        if own is not None:
            its = {column: own["latency"][key] for column, (_, key) in _LEVELS.items()}
            yield Row("engine alone", its, better="lower")


def run() -> list[Table]:
    """Measure all, where there are two processors."""
    cpus = len(os.sched_getaffinity(0))
    title = f"From stream to stream at 1 kHz, 36 sub-apertures of 16 x 16 pixels, {cpus} processors"
    if cpus < 2 or shutil.which("cc") is None:
        return [Table("streams", title, [], ["not measured: needs two processors and a C compiler"])]
    with tempfile.TemporaryDirectory(dir="/dev/shm") as folder:
        return [Table("streams", title, list(_rows(Path(folder))))]
