"""faintspot on an NVIDIA GPU: 4616 sub-apertures of 16 x 16 pixels, 20 iterations, frames of uint16.

The times of the kernel are CUDA's own; those from host to host begin when a frame lies in pinned memory and
end when its slopes do. What else one would use on the GPU is given the stack of images, ready made, in the
GPU's memory: the same algorithm in CuPy and in PyTorch, all images at once, and cuCIM's Chambolle (or, where
that is not installed, scikit-image's on the CPU), image after image. The rows "fast" are those of the preset:
8 iterations from the flat solution's dual field.

A study on the GPU, from start to end and with all processors for its statistics, is compared with two CPU
cores: twice what one does.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

import faintspot as fs
from benchmarks import rivals, study
from benchmarks.measuring import Row, Table, Times, absolute_spread, best, pinned, spread
from benchmarks.rival_numpy import FIRST_MULTIPLIER, momenta
from faintspot.errors import InputError, MissingExtraError
from faintspot.kernels.sweeps import FGP_STEP
from faintspot.study.cell import measure_cell
from faintspot.study.running import run as run_study
from faintspot.study.sweep import Sweep

N, SENSORS = 4616, 6
RATE_HZ, SECONDS = 1000.0, 5.0
KERNEL_US, HOST_US, FAST_US = 60.0, 150.0, 45.0
STUDY_TIMES, STUDY_CELLS, STUDY_REALISATIONS = 20.0, 32, 200_000
TURNS = 20
FASTER_THAN_ARRAYS, FASTER_THAN_LOOPS = 10.0, 50.0
LOOPED_IMAGES = 36  # of what takes one image after the other: so many tell the time of one
COMMAND = "pip install 'faintspot[gpu]' && python -m benchmarks gpu"


def divergence(p: Any, q: Any) -> Any:
    """Divergence of fields (n, ny, nx) along x and y whose far edges are zero."""
    d = p + q
    d[:, :, 1:] -= p[:, :, :-1]
    d[:, 1:] -= q[:, :-1]
    return d


def denoise(library: Any, g: Any, noise_std: float, iterations: int) -> Any:
    """Denoise a stack (n, ny, nx) as faintspot does, in NumPy, CuPy or PyTorch."""
    radius = float(np.sqrt(g.shape[1] * g.shape[2])) * noise_std
    x, y = library.zeros_like(g), library.zeros_like(g)
    old_x, old_y = x, y
    inverse = library.zeros_like(g[:, 0, 0]) + 1.0 / (FIRST_MULTIPLIER * noise_std)
    for momentum in momenta(iterations).tolist():
        qx, qy = x + momentum * (x - old_x), y + momentum * (y - old_y)
        d = divergence(qx, qy)
        v = d - g * inverse[:, None, None]
        old_x, old_y = x, y
        qx[:, :, :-1] += FGP_STEP * (v[:, :, 1:] - v[:, :, :-1])
        qy[:, :-1] += FGP_STEP * (v[:, 1:] - v[:, :-1])
        shrink = 1.0 / library.sqrt((qx * qx + qy * qy).clip(min=1.0))
        x, y = qx * shrink, qy * shrink
        norm = library.sqrt((d * d).sum((1, 2)))
        inverse = library.where(norm > 0, norm / radius, inverse)
    d = divergence(x, y)
    multiplier = radius / library.sqrt((d * d).sum((1, 2)))
    return g - multiplier[:, None, None] * d


def located(library: Any, images: Any, keep: int) -> Any:
    """Keep the brightest pixels ("subtract_next") and take the centre of gravity: (n, ny, nx) -> (n, 2)."""
    n, ny, nx = images.shape
    flat = images.reshape(n, ny * nx)
    if hasattr(library, "topk"):
        threshold = library.topk(flat, keep + 1, 1).values[:, keep]
    else:
        threshold = library.partition(flat, ny * nx - keep - 1, 1)[:, ny * nx - keep - 1]
    left = (images - threshold[:, None, None]).clip(min=0.0)
    ramp = [library.zeros_like(images[0, 0, 0]) + float(i) for i in range(max(ny, nx))]
    x = library.stack(ramp[:nx]) - 0.5 * (nx - 1)
    y = library.stack(ramp[:ny]) - 0.5 * (ny - 1)
    total = left.sum((1, 2))
    return library.stack([(left.sum(1) * x).sum(1) / total, (left.sum(2) * y).sum(1) / total], 1)


def array_rival(library: Any, images: Any) -> Callable[[], Any]:
    """Return the whole measurement of a stack in an array library."""
    return lambda: located(
        library, denoise(library, images, rivals.NOISE_STD, rivals.ITERATIONS), rivals.KEEP
    )


def _array_rivals(images: NDArray[np.float32]) -> dict[str, tuple[Callable[[], Any], Callable[[], None]]]:
    """What to call, and what waits for the GPU, of the array libraries that are installed."""
    found: dict[str, tuple[Callable[[], Any], Callable[[], None]]] = {}
    if rivals.available("cupy"):
        cupy = importlib.import_module("cupy")
        found["CuPy"] = array_rival(cupy, cupy.asarray(images)), cupy.cuda.Device().synchronize
    if rivals.available("torch"):
        torch = importlib.import_module("torch")
        if torch.cuda.is_available():
            stack = torch.as_tensor(images, device="cuda")
            found["PyTorch"] = array_rival(torch, stack), torch.cuda.synchronize
    return found


def _looped_rival(case: rivals.Problem) -> tuple[str, Callable[[], Any], Callable[[], None]] | None:
    """Chambolle by cuCIM or scikit-image on the first images."""
    images = case.images[:LOOPED_IMAGES]
    solved = fs.tv_denoise(
        images, rivals.NOISE_STD, tolerance=0.0, max_iterations=rivals.ITERATIONS, full_output=True
    )
    if rivals.available("cucim") and rivals.available("cupy"):
        cupy = importlib.import_module("cupy")
        theirs = importlib.import_module("cucim.skimage.restoration").denoise_tv_chambolle
        stack, weights = cupy.asarray(images), solved.multiplier.tolist()

        def run() -> None:
            for image, weight in zip(stack, weights, strict=True):
                theirs(image, weight=weight, eps=0.0, max_num_iter=rivals.ITERATIONS)

        return "cuCIM", run, cupy.cuda.Device().synchronize
    if rivals.available("skimage"):
        rival = rivals.skimage_rival(images, solved.multiplier, rivals.ITERATIONS)
        return "scikit-image (CPU)", rival, lambda: None
    return None


def _seconds(
    run: Callable[[], Any], wait: Callable[[], None], turns: int = TURNS, warm_up: int = 3
) -> NDArray[np.float64]:
    """Time calls one after the other, each until the GPU has done it."""
    for _ in range(warm_up):
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
    times = np.empty(TURNS)
    for turn in range(-1, TURNS):  # the first one warms up
        start, stop = cuda.event(), cuda.event()
        start.record(stream)
        for _ in range(launches):
            work.launch(frames, frame.dtype, variants, results, stream)
        stop.record(stream)
        stop.synchronize()
        times[turn] = float(cuda.event_elapsed_time(start, stop)) / 1e3 / launches
    return times


def _stream(pipeline: fs.SlopePipeline, frame: NDArray[Any]) -> Any:
    from faintspot.cuda import FrameStream

    stream = FrameStream(pipeline, frame.dtype)
    stream.frame[:] = frame
    return stream


def _sustained(pipeline: fs.SlopePipeline, frame: NDArray[Any]) -> Row:
    """Several sensors, at a fixed rate; a frame is late that is not done before the next."""
    streams = [_stream(pipeline, frame) for _ in range(SENSORS)]
    count = int(SECONDS * RATE_HZ)
    taken = np.empty((count, SENSORS))
    begin = time.perf_counter() + 0.01
    for i in range(count):
        due = begin + i / RATE_HZ
        while time.perf_counter() < due:
            pass
        for stream in streams:
            stream.submit()
        for k, stream in enumerate(streams):
            stream.wait()
            taken[i, k] = time.perf_counter() - due
    late = int(np.count_nonzero(taken > 1.0 / RATE_HZ))
    values = {
        "median us": float(np.median(taken)) * 1e6,
        "p99.9 us": float(np.quantile(taken, 0.999)) * 1e6,
        "frames": float(taken.size),
        "late": float(late),
    }
    return Row(f"{SENSORS} sensors at {RATE_HZ:g} Hz", values, "late <= 0", late == 0, better="lower")


def _against_others(case: rivals.Problem, kernel_s: NDArray[np.float64]) -> list[Row]:
    """Compare the kernel with array libraries and loops over images, images in the GPU's memory."""
    rows = []
    for name, (run, wait) in _array_rivals(case.images).items():
        differs = float(np.abs(_on_host(run()) - case.slopes()).max())
        rows.append(_ratio_row(name, _seconds(run, wait), kernel_s, FASTER_THAN_ARRAYS, differs))
    looped = _looped_rival(case)
    if looped is not None:
        name, run, wait = looped
        seconds = _seconds(run, wait) * N / LOOPED_IMAGES
        rows.append(_ratio_row(f"{name}, image after image", seconds, kernel_s, FASTER_THAN_LOOPS, None))
    return rows


def _on_host(array: Any) -> NDArray[Any]:
    return np.asarray(array.get() if hasattr(array, "get") else array.cpu())


def _ratio_row(
    name: str,
    seconds: NDArray[np.float64],
    kernel_s: NDArray[np.float64],
    target: float,
    differs_px: float | None,
) -> Row:
    times: Times = {"rival": seconds, "kernel": kernel_s}
    values = {"best us": best(times, "rival") * 1e6, "ratio": _best_ratio(times)}
    if differs_px is not None:
        if differs_px > rivals.SAME_POSITION_PX:
            raise AssertionError(f"{name}: differs from faintspot by {differs_px:g} px")
        values["differs px"] = differs_px
    errors = {"ratio": spread(times, _best_ratio), "best us": absolute_spread(times, "rival")}
    return Row(name, values, f">= {target:g}", values["ratio"] >= target, errors)


def _best_ratio(times: Times) -> float:
    return best(times, "rival") / best(times, "kernel")


def _timed(case: rivals.Problem, frame: NDArray[Any], preset: str) -> tuple[list[Row], NDArray[np.float64]]:
    """Rows of the kernel and from host to host with a preset, and the times of the kernel."""
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
    return rows, kernel_s


def _study_seconds(turns: int = 3) -> NDArray[np.float64]:
    """Seconds for a realisation of a study on the GPU, the start of processes included."""
    fluxes = np.geomspace(20.0, 200.0, STUDY_CELLS).tolist()
    sweep = Sweep("a", flux_e=fluxes, read_noise_e=study.CELL.read_noise_e)
    described = replace(study.SPECIFICATION, sweeps=[sweep], realisations=STUDY_REALISATIONS, device="cuda")
    run_study(replace(described, realisations=1000), workers=0)  # compiles
    seconds = _seconds(lambda: run_study(described), lambda: None, turns, warm_up=0)
    return seconds / STUDY_CELLS / STUDY_REALISATIONS


def _study_row() -> Row:
    """Realisations a second of a study with six arms."""
    on_gpu, realisations = _study_seconds(), study.SPECIFICATION.realisations
    with pinned():
        one_core = _seconds(lambda: measure_cell(study.CELL, study.SPECIFICATION), lambda: None, len(on_gpu))
    times: Times = {"rival": one_core / realisations / 2, "kernel": on_gpu}
    found = _best_ratio(times)
    values = {
        "realisations/s": 1 / best(times, "kernel"),
        "2 cores/s": 1 / best(times, "rival"),
        "ratio": found,
    }
    errors = {"ratio": spread(times, _best_ratio), "realisations/s": absolute_spread(times, "kernel")}
    return Row("study, six arms", values, f">= {STUDY_TIMES:g}", found >= STUDY_TIMES, errors)


def _measured() -> list[Row]:
    """Measure on the GPU that is here."""
    case = rivals.problem(N)
    frame = np.clip(np.rint(case.frame), 0, 65535).astype(np.uint16)
    rows, kernel_s = _timed(case, frame, "accurate")
    fast, _ = _timed(case, frame, "fast")
    pipeline = fs.SlopePipeline(case.layout, case.pipeline.settings, device="cuda")
    return [*rows, *fast, *_against_others(case, kernel_s), _sustained(pipeline, frame), _study_row()]


def _missing() -> str | None:
    """What is missing to measure here; None where nothing is."""
    from faintspot.cuda.availability import check_cuda, simulated

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
    notes = ["ratio: time of the other program to that of faintspot's kernel"]
    notes += [
        f"not installed: {package}" for package in ("cupy", "torch", "cucim") if not rivals.available(package)
    ]
    return [Table("gpu", title, _measured(), notes)]
