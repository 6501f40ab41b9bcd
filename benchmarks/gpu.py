"""faintspot on an NVIDIA GPU: 4616 sub-apertures of 16 x 16 pixels, 20 iterations, frames of uint16.

The times of the kernel are CUDA's own; those from host to host begin when a frame lies in pinned memory and
end when its slopes do. The rows "fast" are those of the preset: 8 iterations from the flat solution's dual
field.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

import faintspot as fs
from benchmarks import rivals
from benchmarks.measuring import Row, Table, Times, absolute_spread
from faintspot.base.errors import InputError, MissingExtraError

N = 4616
KERNEL_US, HOST_US, FAST_US = 60.0, 150.0, 45.0
COMMAND = "pip install 'faintspot[gpu]' && python -m benchmarks gpu"


def _seconds(run: Callable[[], Any], wait: Callable[[], None], turns: int) -> NDArray[np.float64]:
    """Time calls one after the other, each until the GPU has done it."""
    for _ in range(3):
        run()
    wait()
    times = np.empty(turns)
    for i in range(turns):
        start = time.perf_counter()
        run()
        wait()
        times[i] = time.perf_counter() - start
    return times


def _kernel_seconds(pipeline: fs.SlopePipeline, frame: NDArray[Any], launches: int = 50) -> Any:
    """Times of the kernel alone, between two events of the GPU, each the mean of launches in a row."""
    from numba import cuda

    work = pipeline.on_device
    assert work is not None
    frames, variants = cuda.to_device(frame[None]), cuda.to_device(np.zeros(1, np.int32))
    results, stream = work.new_results(1), cuda.stream()
    times = np.empty(20)
    for turn in range(-1, len(times)):  # the first one warms up
        start, stop = cuda.event(), cuda.event()
        start.record(stream)
        for _ in range(launches):
            work.launch(frames, frame.dtype, variants, results, stream)
        stop.record(stream)
        stop.synchronize()
        times[turn] = float(cuda.event_elapsed_time(start, stop)) / 1e3 / launches
    return times


def _stream(pipeline: fs.SlopePipeline, frame: NDArray[Any]) -> Any:
    from faintspot.slopes.pipeline.device_stream import FrameStream

    stream = FrameStream(pipeline, frame.dtype)
    stream.frame[:] = frame
    return stream


def _timed(case: rivals.Problem, frame: NDArray[Any], preset: str) -> list[Row]:
    """Rows of the kernel and from host to host with a preset."""
    settings, name, most_us = case.pipeline.settings, "", (KERNEL_US, HOST_US)
    if preset == "fast":
        settings = fs.Settings(noise_std=rivals.NOISE_STD, keep_brightest=rivals.KEEP, preset="fast")
        name, most_us = ", fast", (FAST_US, HOST_US)
    pipeline = fs.SlopePipeline(case.layout, settings, device="cuda")
    differs = float(
        np.abs(pipeline(frame).vector - fs.SlopePipeline(case.layout, settings)(frame).vector).max()
    )
    kernel_s, stream = _kernel_seconds(pipeline, frame), _stream(pipeline, frame)
    host_s = _seconds(stream.submit, stream.wait, 2000)
    times: Times = {"kernel": kernel_s, "host": host_s}
    kernel = {"best us": float(kernel_s.min()) * 1e6, "differs px": differs}
    host = {
        "best us": float(host_s.min()) * 1e6,
        "median us": float(np.median(host_s)) * 1e6,
        "p99.9 us": float(np.quantile(host_s, 0.999)) * 1e6,
        "one graph": float(stream.captured),
    }
    rows = []
    for which, values, column, most in (
        ("kernel", kernel, "best us", most_us[0]),
        ("host", host, "median us", most_us[1]),
    ):
        part = {which: times[which]}
        met = values[column] <= most
        title = "kernel" if which == "kernel" else "host to host"
        errors = {"best us": absolute_spread(part, which)}
        rows.append(Row(title + name, values, f"<= {most:g} us", met, errors, better="lower"))
    return rows


def _measured() -> list[Row]:
    """Measure on the GPU that is here."""
    case = rivals.problem(N)
    frame = np.clip(np.rint(case.frame), 0, 65535).astype(np.uint16)
    return [row for preset in ("accurate", "fast") for row in _timed(case, frame, preset)]


def _missing() -> str | None:
    """What is missing to measure here; None where nothing is."""
    from faintspot.slopes.kernels.cuda.availability import check_cuda, simulated

    try:
        check_cuda()
    except (InputError, MissingExtraError) as error:
        return str(error)
    return "NUMBA_ENABLE_CUDASIM is set: the simulator's times mean nothing" if simulated() else None


def run() -> list[Table]:
    """Measure, or say what is missing."""
    title = f"On a GPU: {N} sub-apertures of 16 x 16 pixels, {rivals.ITERATIONS} iterations"
    missing = _missing()
    if missing is not None:
        return [Table("gpu", title, [], [f"not measured: {missing}", f"on a machine with a GPU: {COMMAND}"])]
    return [Table("gpu", title, _measured())]
