"""Where the time goes: each stage of the way from frame to slopes, per sub-aperture.

Denoising (20 iterations), finding the threshold of the brightest pixels, subtracting it and the centre of
gravity are timed one by one, by the kernels that the pipeline is made of, on one group of W sub-apertures
in loops compiled here. "gather, calibrate, store" is the difference of the pipeline that does not
denoise and the last three (it includes normalising the images, so that the sum is a little above the whole).
All in turns, on one processor, the best of all turns. The second table is the pipeline alone, with threads.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from benchmarks.measuring import Candidate, Row, Table, best, interleaved, pinned
from benchmarks.rivals import ITERATIONS, KEEP, NOISE_STD, Problem, problem
from faintspot.kernels import brightest, total_variation
from faintspot.kernels.flat_start import flat_start_table
from faintspot.kernels.gravity import gravity_scratch
from faintspot.kernels.groups import new_scratch
from faintspot.kernels.host import lanes_for
from faintspot.kernels.parallel import available_cpus

SIDES = (8, 10, 16, 32)
WIDTHS = (16, 8, 4)
BATCHES = (1, 36, 4616)
_GROUPS = 64  # in a call of the pipeline: many, so that the call itself does not count
_REPEATS = 20  # of a stage in a call

_find_threshold = brightest.find_threshold
_subtract_background = brightest.subtract_background
_centre_of_gravity = brightest.centre_of_gravity
_denoise_group = total_variation.denoise_group


@njit(nogil=True, error_model="numpy")  # type: ignore[untyped-decorator, unused-ignore]
def _denoise(count: Any, lanes: Any, table: Any, ny: Any, nx: Any, scratch: Any) -> None:
    own = scratch.own
    for _ in range(count):
        _denoise_group(
            lanes,
            total_variation.FGP,
            True,
            table,
            ny,
            nx,
            scratch.image,
            scratch.spare,
            own.state,
            own.rows,
            own.denoiser,
            own.counts,
        )


@njit(nogil=True, error_model="numpy")  # type: ignore[untyped-decorator, unused-ignore]
def _threshold(count: Any, lanes: Any, pixels: Any, image: Any, numbers: Any) -> None:
    for _ in range(count):
        _find_threshold(lanes, image, pixels, numbers)


@njit(nogil=True, error_model="numpy")  # type: ignore[untyped-decorator, unused-ignore]
def _subtract(count: Any, lanes: Any, pixels: Any, image: Any, numbers: Any) -> None:
    for _ in range(count):
        _subtract_background(lanes, image, pixels, numbers, image)


@njit(nogil=True, error_model="numpy")  # type: ignore[untyped-decorator, unused-ignore]
def _centroid(count: Any, lanes: Any, ny: Any, nx: Any, image: Any, numbers: Any) -> None:
    for _ in range(count):
        _centre_of_gravity(lanes, image, ny, nx, numbers)


def _stages(case: Problem, side: int, width: int) -> dict[str, Candidate]:
    """Return a run of every stage, _REPEATS times on the first W sub-apertures."""
    lanes, pixels = lanes_for(np.float32, width), side * side
    own = gravity_scratch(lanes, side, side)
    scratch = new_scratch(lanes, side, side, own)
    scratch.image.reshape(-1, width)[:pixels] = case.images[:width].reshape(width, pixels).T
    rows = own.denoiser.reshape(-1, width)
    rows[total_variation.STRENGTH], rows[total_variation.TOLERANCE] = NOISE_STD, 0.0
    own.counts.reshape(-1, width)[total_variation.LIMIT] = ITERATIONS
    centroid = own.centroid
    rows = centroid.reshape(-1, width)
    rows[brightest.RANK], rows[brightest.SUBTRACT] = KEEP + 1, 1.0
    table = flat_start_table(side, side)
    _denoise(1, lanes, table, side, side, scratch)
    denoised, left = scratch.spare.copy(), scratch.spare.copy()
    _threshold(1, lanes, pixels, denoised, centroid)
    return {
        "denoise": lambda: _denoise(_REPEATS, lanes, table, side, side, scratch),
        "threshold": lambda: _threshold(_REPEATS, lanes, pixels, denoised, centroid),
        "subtract": lambda: _subtract(_REPEATS, lanes, pixels, left, centroid),
        "centroid": lambda: _centroid(_REPEATS, lanes, side, side, left, centroid),
    }


def _stage_row(side: int, width: int) -> Row:
    n = _GROUPS * width
    case, undenoised = problem(n, side, width=width), problem(n, side, width=width, estimator="brightest")
    stages = _stages(case, side, width)
    pipelines: dict[str, Candidate] = {"whole": case.slopes, "undenoised": undenoised.slopes}
    times = interleaved(stages | pipelines, seconds=1.0, fewest=10)
    each = {name: best(times, name) / (_REPEATS * width) * 1e6 for name in stages}
    whole, undenoised_us = (best(times, name) / n * 1e6 for name in pipelines)
    gather = undenoised_us - sum(each.values()) + each["denoise"]
    each = {"gather, calibrate, store": gather} | each
    values = {f"{name} us": us for name, us in each.items()}
    return Row(f"{side} x {side}, W = {width}", values | {"pipeline us": whole})


def _pipeline_row(n: int) -> Row:
    """Measure the pipeline for all widths, on one thread and on two."""
    candidates: dict[str, Candidate] = {}
    for threads in (1, 2):
        for width in WIDTHS:
            case = problem(n, threads=threads, width=width)
            candidates[f"W {width}, {threads} thread{'s' if threads > 1 else ''}"] = case.slopes
    times = interleaved(candidates, seconds=4.0)
    return Row(f"{n} sub-apertures", {f"{name} us": best(times, name) / n * 1e6 for name in candidates})


def run() -> list[Table]:
    """Measure stages and pipeline."""
    with pinned():
        stages = [_stage_row(side, width) for side in SIDES for width in WIDTHS]
    batches = [_pipeline_row(n) for n in BATCHES]
    title = "Stages, one thread, us per sub-aperture"
    notes = [f"{available_cpus()} processors; fewer than 32 groups are not shared among threads"]
    return [
        Table("breakdown_stages", title, stages),
        Table("breakdown_pipeline", "Pipeline, us per sub-aperture of 16 x 16 pixels", batches, notes),
    ]
