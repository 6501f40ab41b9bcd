"""How throughput grows with the sensor: time per frame by number of sub-apertures, their size and processors.

Frame to slopes, one frame a call. For each window size, all numbers of sub-apertures take turns, on one
thread and on two; nothing is pinned, since the two threads need a processor each. Two statements are
tested: two processors do nearly twice the work of one for the largest sensor, and a sub-aperture of a large
sensor costs no more than one of a small sensor. That the cost is linear is shown by a fit, time = call + n
x each, weighted so that every sensor counts by its relative deviation. Fewer than 32 groups of W
sub-apertures are not shared between threads, because waking one costs more than it saves: there, two
processors do as one does.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.frames.rivals import GRIDS, problem
from benchmarks.measuring import Candidate, Row, Table, Times, best, interleaved, ratio
from faintspot.slopes.kernels.parallel import available_cpus

SMALLEST, LARGEST = min(GRIDS), max(GRIDS)
SIDES = (8, 10, 16)
SHARED_FROM = 1000  # sub-apertures: fewer are not shared between threads, see above
SPEED_UP, COST = 1.8, 1.0
SECONDS = 15.0
SAMPLE_S = 0.05  # several large frames: the first one finds the caches as other candidates left them


def settings() -> dict[str, Any]:
    """Return the denoising that all frames get: that of the preset "fast"."""
    return {"preset": "fast", "max_iterations": None, "tolerance": None}


def settings_in_words() -> str:
    """Return the settings for a note."""
    return ", ".join(f"{name} = {value}" for name, value in settings().items() if value is not None)


def _times(side: int) -> Times:
    """Time all sensors with windows of side x side pixels, in turns; by "n, threads"."""
    candidates: dict[str, Candidate] = {
        f"{n}, {threads}": problem(n, side, threads=threads, **settings()).slopes
        for n in GRIDS
        for threads in (1, 2)
    }
    return interleaved(candidates, seconds=SECONDS, sample_s=SAMPLE_S)


def _row(side: int, n: int, times: Times) -> Row:
    one, two = f"{n}, 1", f"{n}, 2"
    speed_up = ratio(times, one, two, ("2 cores / 1 core", "median"))
    values = {
        "sub-apertures": float(n),
        "1 core: us per frame": best(times, one) * 1e6,
        "2 cores: us per frame": best(times, two) * 1e6,
        "1 core: frames/s": 1 / best(times, one),
        "2 cores: frames/s": 1 / best(times, two),
        "1 core: us per sub-aperture": best(times, one) / n * 1e6,
        "2 cores: us per sub-aperture": best(times, two) / n * 1e6,
        **speed_up.values,
    }
    known = speed_up.spread if n >= SHARED_FROM else {}
    return Row(f"{n} of {side} x {side}", values, spread=known, better="higher")


def linear_fit(numbers: NDArray[np.float64], times: NDArray[np.float64]) -> tuple[float, float, float]:
    """Fit time = call + n * each by relative deviations; return call, each, and the largest deviation."""
    design = np.stack([1 / times, numbers / times], axis=1)
    (call, each), *_ = np.linalg.lstsq(design, np.ones_like(times), rcond=None)
    return float(call), float(each), float(np.abs((call + each * numbers) / times - 1).max())


def _fit_row(side: int, threads: int, times: Times) -> Row:
    numbers = np.array([n for n in GRIDS if threads == 1 or n >= SHARED_FROM], float)
    measured = np.array([best(times, f"{int(n)}, {threads}") for n in numbers])
    if len(numbers) > 2:
        call, each, deviation = linear_fit(numbers, measured)
        values = {"call us": call * 1e6, "each us": each * 1e6, "largest deviation %": 100 * deviation}
    else:
        values = {"each us": float(measured[-1] / numbers[-1] * 1e6)}
    values["exponent"] = float(np.polyfit(np.log(numbers), np.log(measured), 1)[0])
    cores = "1 core" if threads == 1 else f"2 cores, from {SHARED_FROM} on"
    return Row(f"{side} x {side}, {cores}", values)


def _two_cores(side: int) -> Times:
    """Time the largest sensor on one core and on two, and nothing else: its frames stay in the cache."""
    cases = {str(threads): problem(LARGEST, side, threads=threads, **settings()) for threads in (1, 2)}
    candidates: dict[str, Candidate] = {name: case.slopes for name, case in cases.items()}
    return interleaved(candidates, seconds=SECONDS, sample_s=SAMPLE_S)


def _targets(side: int, times: Times) -> list[Row]:
    speed_up = ratio(_two_cores(side), "1", "2")
    per_subaperture = {name: values / int(name.split(",")[0]) for name, values in times.items()}
    cost = ratio(per_subaperture, f"{LARGEST}, 1", f"{SMALLEST}, 1")
    return [
        Row(
            f"{LARGEST} of {side} x {side}: throughput of 2 cores over 1",
            speed_up.values,
            f">= {SPEED_UP:g}",
            speed_up.smaller >= SPEED_UP,
            speed_up.spread,
        ),
        Row(
            f"{side} x {side}: cost of one of {LARGEST} over one of {SMALLEST}",
            cost.values,
            f"<= {COST:g}",
            cost.larger <= COST,
            cost.spread,
        ),
    ]


def run() -> list[Table]:
    """Measure all sensors."""
    rows, fits = [], []
    for side in SIDES:
        times = _times(side)
        rows += [_row(side, n, times) for n in GRIDS]
        fits += [_fit_row(side, threads, times) for threads in (1, 2)]
    targets = _targets(SIDES[-1], times)
    note = f"{settings_in_words()}; {available_cpus()} processors; best of all turns"
    return [
        Table("scale_targets", "Does it scale?", targets, ["a target is met when both ratios meet it"]),
        Table("scale", "Frame to slopes by sensor", rows, [note]),
        Table(
            "scale_fit",
            "Is the cost linear in the number of sub-apertures?",
            fits,
            ["exponent: of time against number of sub-apertures; below 1: the call's own cost is spread"],
        ),
    ]
