"""faintspot on an NVIDIA GPU: 4616 sub-apertures of 16 x 16 pixels, 20 iterations, frames of uint16.

The times of the kernel are CUDA's own; those from host to host begin when a frame lies in pinned memory and
end when its slopes do. What else one would use on the GPU is given the stack of images, ready made, in the
GPU's memory: the same algorithm in CuPy and in PyTorch, all images at once, and cuCIM's Chambolle (or, where
that is not installed, scikit-image's on the CPU), image after image.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

import faintspot as fs
from benchmarks import rivals
from benchmarks.measuring import Row, Table
from benchmarks.rival_numpy import momenta
from faintspot.errors import InputError, MissingExtraError
from faintspot.kernels.sweeps import FGP_STEP
from faintspot.kernels.total_variation import FIRST_MULTIPLIER

N, SENSORS = 4616, 6
RATE_HZ, SECONDS = 1000.0, 5.0
KERNEL_US, HOST_US = 60.0, 150.0
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


def _seconds(run: Callable[[], Any], wait: Callable[[], None], turns: int = 20) -> NDArray[np.float64]:
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


def _kernel_seconds(pipeline: fs.SlopePipeline, frame: NDArray[Any], launches: int = 200) -> float:
    """Time of the kernel alone, between two events of the GPU, mean over launches in a row."""
    from numba import cuda

    work = pipeline.on_device
    assert work is not None
    frames, variants = cuda.to_device(frame[None]), cuda.to_device(np.zeros(1, np.int32))
    results, stream = work.new_results(1), cuda.stream()
    start, stop = cuda.event(), cuda.event()
    for event, count in ((start, 10), (stop, launches)):
        for _ in range(count):
            work.launch(frames, frame.dtype, variants, results, stream)
        event.record(stream)
    stop.synchronize()
    return float(cuda.event_elapsed_time(start, stop)) / 1e3 / launches


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
    return Row(f"{SENSORS} sensors at {RATE_HZ:g} Hz", values, "late <= 0", late == 0)


def _against_others(case: rivals.Problem, kernel_s: float) -> list[Row]:
    """Compare the kernel with array libraries and loops over images, images in the GPU's memory."""
    rows = []
    for name, (run, wait) in _array_rivals(case.images).items():
        differs = float(np.abs(_on_host(run()) - case.slopes()).max())
        times = _seconds(run, wait)
        rows.append(_ratio_row(name, float(times.min()), kernel_s, FASTER_THAN_ARRAYS, differs))
    looped = _looped_rival(case)
    if looped is not None:
        name, run, wait = looped
        seconds = float(_seconds(run, wait, 5).min()) * N / LOOPED_IMAGES
        rows.append(_ratio_row(f"{name}, image after image", seconds, kernel_s, FASTER_THAN_LOOPS, None))
    return rows


def _on_host(array: Any) -> NDArray[Any]:
    return np.asarray(array.get() if hasattr(array, "get") else array.cpu())


def _ratio_row(name: str, seconds: float, kernel_s: float, target: float, differs_px: float | None) -> Row:
    values = {"best us": seconds * 1e6, "ratio": seconds / kernel_s}
    if differs_px is not None:
        if differs_px > rivals.SAME_POSITION_PX:
            raise AssertionError(f"{name}: differs from faintspot by {differs_px:g} px")
        values["differs px"] = differs_px
    return Row(name, values, f">= {target:g}", values["ratio"] >= target)


def _measured() -> list[Row]:
    """Measure on the GPU that is here."""
    case = rivals.problem(N)
    frame = np.clip(np.rint(case.frame), 0, 65535).astype(np.uint16)
    pipeline = fs.SlopePipeline(case.layout, case.pipeline.settings, device="cuda")
    same = fs.SlopePipeline(case.layout, case.pipeline.settings)(frame)
    differs = float(np.abs(pipeline(frame).vector - same.vector).max())
    kernel_s = _kernel_seconds(pipeline, frame)
    stream = _stream(pipeline, frame)
    times = _seconds(stream.submit, stream.wait, 2000)
    host = {
        "best us": float(times.min()) * 1e6,
        "median us": float(np.median(times)) * 1e6,
        "p99.9 us": float(np.quantile(times, 0.999)) * 1e6,
        "one graph": float(stream.captured),
    }
    kernel = {"best us": kernel_s * 1e6, "differs px": differs}
    return [
        Row("kernel", kernel, f"<= {KERNEL_US:g} us", kernel["best us"] <= KERNEL_US),
        Row("host to host", host, f"<= {HOST_US:g} us", host["median us"] <= HOST_US),
        *_against_others(case, kernel_s),
        _sustained(pipeline, frame),
    ]


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
