"""What six sensors of 80 x 80 sub-apertures need, projected from one that is measured.

One 4616-sub-aperture frame is measured on all processors that the process may use, with each way of measuring
in turn. From that: cores = sensors x frames/s x time x processors, as if every sensor had its own cores and
they scaled as the measured ones do (`scale` says how they do). A core that is busy all the time has no
reserve for the tail: build with one half more. Beside it, what must be moved: pixels from the cameras, and,
where several sensors' calibration maps do not stay in the cache, these in every frame; against the memory's
bandwidth as a plain copy has it. The larger one of both fractions of a processor's time is the limit.
"""

from typing import Any

import numpy as np

from benchmarks.frames.rivals import problem
from benchmarks.frames.scale import settings as fast
from benchmarks.measuring import Candidate, Row, Table, absolute_spread, best, interleaved
from faintspot.slopes.kernels.parallel import available_cpus

SENSORS, RATES_HZ, LIT = 6, (500.0, 1000.0), 4616
_COPIED_BYTES = 256 * 2**20
_PIXEL_BYTES, _MAP_BYTES = 2, 8  # uint16 from the camera; dark and scale, float32
WAYS: dict[str, tuple[int, dict[str, Any]]] = {
    "TV, preset fast, 16 x 16": (16, fast()),
    "TV, preset fast, 10 x 10": (10, fast()),
    "TV, preset fast, 8 x 8": (8, fast()),
    "TV, 20 iterations, 16 x 16": (16, {}),
    "smoothed, 16 x 16": (16, {"estimator": "smoothed"}),
    "brightest pixels, 16 x 16": (16, {"estimator": "brightest"}),
    "brightest pixels, 8 x 8": (8, {"estimator": "brightest"}),
}


def _row(name: str, side: int, seconds: float, sure: float, bytes_per_second: float) -> Row:
    processors = available_cpus()
    moved = LIT * side**2 * (_PIXEL_BYTES + _MAP_BYTES)
    values = {"ms per frame": 1e3 * seconds}
    for rate in RATES_HZ:
        values[f"{rate:g} Hz: cores"] = SENSORS * rate * seconds * processors
    rate = RATES_HZ[-1]
    values[f"{rate:g} Hz: Gbit/s of pixels"] = 8e-9 * SENSORS * rate * LIT * side**2 * _PIXEL_BYTES
    values[f"{rate:g} Hz: GB/s of memory"] = 1e-9 * SENSORS * rate * moved
    values["memory / arithmetic"] = moved / bytes_per_second / seconds
    return Row(name, values, spread={"ms per frame": sure}, better="lower")


def run() -> list[Table]:
    """Measure one sensor and project six."""
    source = np.zeros(_COPIED_BYTES // 8)
    target = np.ones_like(source)
    candidates: dict[str, Candidate] = {"copy": lambda: np.copyto(target, source)}
    for name, (side, settings) in WAYS.items():
        candidates[name] = problem(LIT, side, threads=available_cpus(), **settings).slopes
    times = interleaved(candidates, seconds=20.0)
    bandwidth = 2 * _COPIED_BYTES / best(times, "copy")
    rows = [
        _row(name, side, best(times, name), absolute_spread(times, name), bandwidth)
        for name, (side, _) in WAYS.items()
    ]
    notes = [
        f"{SENSORS} sensors of 80 x 80, {LIT} lit sub-apertures each; one measured on {available_cpus()} "
        f"processors; one thread copies {1e-9 * bandwidth:.1f} GB/s (read and written)",
        "cores: without reserve; memory / arithmetic: time to move pixels and calibration maps over the time "
        "measured, both on the same processors: below 1, arithmetic limits",
    ]
    return [Table("projection", "Six sensors of 80 x 80: cores and bandwidth", rows, notes)]
