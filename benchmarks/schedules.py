"""How much work is enough? The slope error R of fewer iterations against that of the converged solution.

What matters is the slope, not the image: a schedule (start, algorithm, number of iterations or test) is good
enough where R is within 1 % of what the converged denoising gives on the same images. Measured on the 24
reference cases of the studies, 5 near the limit of detection and 8 others (windows, widths and elongations
that are not among them), each with four strengths: 0.5, 0.7, 0.85 and 1 times the noise of a mean pixel,
sqrt(read noise^2 + flux / pixels). Converged: to a tolerance of 1e-6, at most 3,000 iterations.
The number of kept pixels is the same for all schedules: the smallest one whose converged R, on other images,
is within 0.5 % of the smallest; and in tables of their own twice as many, and those of the automatic rules
(with their strength). A warm start from the frame before is left out: it pays only at very low read noise.

The excess (R - converged R) / converged R has a standard error that is much smaller than that of either R, as
the images are the same; where that of "fast" is above 0.3 %, more images are measured, up to five times as
many. "Distance" is the mean change of the position, over the converged R: it can be large while R stays the
same, because positions that differ may be equally good. The estimators that know the spot are measured alike,
by their steps, within the range of true positions and in the whole window. Times are those of a pipeline,
frame to slopes, on one thread, of a sensor that sees all cases with 16 x 16 pixels at all strengths.

`python -m benchmarks.schedules --quick` takes minutes, `--pictures FOLDER` draws what docs/fast.md shows.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import click
import numpy as np

import faintspot as fs
from benchmarks import showing
from benchmarks.measuring import Candidate, Row, Table, Times, interleaved, pinned, ratio
from benchmarks.schedule_cases import (
    CASES,
    ENOUGH,
    Case,
    Compared,
    Floats,
    Images,
    compared,
    differences,
    psf_of,
    sample,
)
from benchmarks.schedule_steps import tables_of_steps
from faintspot.estimators import measure
from faintspot.estimators.gravity import FLUX_FLOOR
from faintspot.kernels import scoring

REALISATIONS, QUICK_REALISATIONS = 4000, 500
MOST_BLOCKS, SMALL_ENOUGH = 5, 0.003  # of so many realisations, until the standard error of "fast" is that
STRENGTHS = (0.5, 0.7, 0.85, 1.0)
ITERATIONS = (3, 4, 5, 6, 8, 10, 12, 15, 20, 30, 40, 60, 100)
CHAMBOLLE_ITERATIONS = (24, 80, 160, 480)
CONVERGED: dict[str, Any] = {"tolerance": 1e-6, "max_iterations": 3000}
BASE, FAST, ACCURATE = "20 iterations", "fast: 8 iterations", "accurate: tolerance 0.02"
GENEROUS = (FAST, "12 iterations", "15 iterations", BASE, "30 iterations", ACCURATE)
"""Schedules that are measured with twice as many kept pixels, too."""
NEARLY_INFEASIBLE = ("rn3_f80", 1.0)
_SAME_ERROR = 1.005
_LOST = 0.9
_TIMED_PER_CELL = 16  # images, as many as have one strength in one vector of the widest kind


def schedules() -> dict[str, dict[str, Any]]:
    """Return the settings of every schedule by name."""
    found: dict[str, dict[str, Any]] = {
        _of_iterations(n): {"tolerance": 0.0, "max_iterations": n} for n in ITERATIONS
    }
    for n in CHAMBOLLE_ITERATIONS:
        settings = {"tolerance": 0.0, "max_iterations": n, "algorithm": "chambolle"}
        found[f"Chambolle, {n} iterations"] = settings
    found[ACCURATE] = {}
    found["tolerance 0.005"] = {"tolerance": 0.005}
    return found


def _of_iterations(n: int) -> str:
    return FAST if n == 8 else f"{n} iterations"


@dataclass(frozen=True)
class Found:
    """All schedules of one case and strength."""

    case: Case
    strength: float
    keep: int
    realisations: int
    converged_px: float
    by_schedule: dict[str, Compared] = field(default_factory=dict)

    @property
    def is_best(self) -> bool:
        """Whether no other of the strengths suits the case better."""
        best = self.case.best
        return best is not None and self.strength == max(best, STRENGTHS[0])

    @property
    def is_lost(self) -> bool:
        """Whether always answering the middle would be about as good as the converged denoising."""
        return self.converged_px > _LOST * self.case.cell.position_range_px / 2

    @property
    def name(self) -> str:
        """Case and strength (0: automatic); * marks the one that suits the case best."""
        return f"{self.case.name}, {self.strength:g}{'*' if self.is_best else ''}"


def kept_pixels(case: Case, noise_std: float, images: Images, truth: Floats) -> int:
    """Return the smallest number of kept pixels whose converged R is nearly the smallest."""
    denoised = fs.tv_denoise(images, noise_std, **CONVERGED).reshape(len(images), -1)
    errors = np.empty((len(images), denoised.shape[1] - 1), np.float32)
    scoring.errors_of_every_k(
        denoised,
        case.cell.pixels,
        scoring.SUBTRACT_NEXT,
        FLUX_FLOOR,
        np.inf,
        truth,
        0,
        len(images),
        errors,
        np.empty(errors.shape, np.bool_),
    )
    error = errors.mean(axis=0, dtype=np.float64)
    return int(np.argmax(error <= _SAME_ERROR * error.min())) + 1


def of_case(
    case: Case,
    strength: float,
    realisations: int,
    chosen: dict[str, dict[str, Any]],
    most_blocks: int = 1,
    generosity: int = 1,
) -> Found:
    """Measure schedules on one case with one strength, and `generosity` times the best number of pixels."""
    noise_std, number = strength * case.pixel_noise_e, [c.name for c in CASES].index(case.name)
    keep = kept_pixels(case, noise_std, *sample(case, max(realisations // 2, 250), number, 0))
    keep = min(generosity * keep, case.cell.pixels**2 - 1)
    usual: dict[str, Any] = {"noise_std": noise_std, "keep_brightest": keep}
    parts: dict[str, list[Floats]] = {name: [] for name in chosen}
    for block in range(1, most_blocks + 1):
        images, truth = sample(case, realisations, number, block)
        converged = measure(images, fs.Settings(**usual, **CONVERGED))
        for name, settings in chosen.items():
            slopes = measure(images, fs.Settings(**usual, **settings))
            parts[name].append(differences(slopes, converged, truth))
        fast = compared(np.concatenate(parts[FAST], axis=1))
        if fast.excess.standard_error < SMALL_ENOUGH:
            break
    whole = {name: np.concatenate(each, axis=1) for name, each in parts.items()}
    by_schedule = {name: compared(each) for name, each in whole.items()}
    return Found(case, strength, keep, block * realisations, float(whole[FAST][1].mean()), by_schedule)


def timed(seconds: float) -> Times:
    """Time the pipeline with every schedule."""
    cases = [case for case in CASES if case.cell.pixels == 16]
    stacks = [sample(case, _TIMED_PER_CELL * len(STRENGTHS), 99, i)[0] for i, case in enumerate(cases)]
    images = np.concatenate(stacks)
    strength = [f * case.pixel_noise_e for case in cases for f in STRENGTHS for _ in range(_TIMED_PER_CELL)]
    n = len(images)
    corners = np.column_stack([16 * np.arange(n), np.zeros(n, np.int64)])
    layout, frame = fs.Layout((16 * n, 16), (16, 16), corners), images.reshape(16 * n, 16)
    candidates: dict[str, Candidate] = {}
    for name, settings in schedules().items():
        chosen = fs.Settings(noise_std=np.array(strength), keep_brightest=12, **settings)
        candidates[name] = partial(fs.SlopePipeline(layout, chosen, threads=1), frame)
    with pinned():
        return interleaved(candidates, seconds=seconds)


def _row(name: str, found: list[Found], times: Times) -> Row:
    each = [cell.by_schedule[name] for cell in found]
    best = [cell.by_schedule[name].excess.value for cell in found if cell.is_best]
    worst = max(each, key=lambda one: one.excess.value)
    cost = ratio(times, name, BASE, ("of 20 iterations", "median"))
    values = {
        "worst %": 100 * worst.excess.value,
        "+- %": 100 * worst.excess.standard_error,
        "median %": 100 * float(np.median([one.excess.value for one in each])),
        "> 1 %": float(sum(one.is_too_far for one in each)),
        "surely": float(sum(one.is_surely_too_far for one in each)),
        "worst* %": 100 * max(best),
        "distance": float(np.median([one.distance for one in each])),
        "iterations": float(np.mean([one.iterations for one in each])),
        **cost.values,
    }
    if name == FAST:
        met = not any(one.is_surely_too_far for one in each)
        return Row(name, values, "surely: 0", met, cost.spread)
    return Row(name, values, spread=cost.spread if name != BASE else {}, better="lower")


def table_of(name: str, title: str, found: list[Found]) -> Table:
    """Arrange what was found with other numbers of kept pixels, by schedule."""
    rows = []
    found = [cell for cell in found if not cell.is_lost]
    for schedule in found[0].by_schedule:
        each = [cell.by_schedule[schedule] for cell in found]
        worst = max(range(len(found)), key=lambda i: each[i].excess.value)
        excess = np.array([one.excess.value for one in each])
        values = {
            "worst %": 100 * float(excess.max()),
            "+- %": 100 * each[worst].excess.standard_error,
            "median %": 100 * float(np.median(excess)),
            "> 1 %": float((excess > ENOUGH).sum()),
            "surely": float(sum(one.is_surely_too_far for one in each)),
        }
        rows.append(Row(f"{schedule}: worst in {found[worst].name}", values))
    return Table(name, f"{title}, {len(found)} cells", rows)


def of_automatic(case: Case, realisations: int) -> Found:
    """Measure schedules with the strength and the number of kept pixels of the automatic rules."""
    cell, number = case.cell, [c.name for c in CASES].index(case.name)
    images, truth = sample(case, realisations, number, 1)
    usual: dict[str, Any] = {"noise_std": "auto", "keep_brightest": "auto", "flux_e": cell.flux_e}
    usual["search_range_px"] = cell.position_range_px
    known: dict[str, Any] = {
        "calibration": fs.Calibration(read_noise_e=cell.read_noise_e),
        "psf": psf_of(case),
    }
    converged = measure(images, fs.Settings(**usual, **CONVERGED), **known)
    found = {
        name: differences(measure(images, fs.Settings(**usual, **settings), **known), converged, truth)
        for name, settings in schedules().items()
        if name in GENEROUS
    }
    by_schedule = {name: compared(each) for name, each in found.items()}
    return Found(case, 0.0, 0, realisations, float(found[FAST][1].mean()), by_schedule)


def _curves(found: list[Found]) -> dict[str, list[tuple[float, float]]]:
    """Excess in percent over all cells against iterations, and how many are above 1 %."""
    names = [_of_iterations(n) for n in ITERATIONS]
    excess = 100 * np.array([[cell.by_schedule[name].excess.value for cell in found] for name in names])
    curves = {
        "worst": excess.max(axis=1),
        "median": np.median(excess, axis=1),
        "cells": (excess > 100 * ENOUGH).sum(axis=1),
    }
    return {which: list(zip(ITERATIONS, values.tolist(), strict=True)) for which, values in curves.items()}


def _curves_of_cell(cell: Found, label: str) -> dict[str, list[tuple[float, float]]]:
    """R of one cell against iterations."""
    errors = [cell.by_schedule[_of_iterations(n)].error_px for n in ITERATIONS]
    return {
        f"converged: R, px, {label}": [(float(n), cell.converged_px) for n in ITERATIONS],
        f"R, px, {label}": list(zip(ITERATIONS, errors, strict=True)),
    }


def table_of_nearly_infeasible(realisations: int, most_blocks: int) -> Table:
    """Measure a case whose strength is close to the images' own rms, by number of kept pixels."""
    name, strength = NEARLY_INFEASIBLE
    case = next(case for case in CASES if case.name == name)
    curves: dict[str, list[tuple[float, float]]] = {}
    rows = []
    for generosity in (1, 2, 3):
        cell = of_case(case, strength, realisations, schedules(), most_blocks, generosity)
        label = f"{cell.keep} kept pixels"
        rows.append(_cell_row(cell, label))
        curves |= _curves_of_cell(cell, label)
    return Table("schedules_infeasible", f"{case.name}, strength {strength:g}", rows, [], curves)


def _cell_row(cell: Found, label: str = "") -> Row:
    values = {
        "k": float(cell.keep),
        "images": float(cell.realisations),
        "R px": cell.converged_px,
    }
    for short, name in (
        ("fast", FAST),
        ("accurate", ACCURATE),
        ("20 iterations", BASE),
    ):
        one = cell.by_schedule[name]
        values[f"{short} %"] = 100 * one.excess.value
        values[f"{short} +- %"] = 100 * one.excess.standard_error
    return Row(label or cell.name, values)


def tables_of_denoising(found: list[Found], times: Times) -> list[Table]:
    """Arrange what was found: by schedule, by cell, and where "fast" is not good enough."""
    names = list(found[0].by_schedule)
    judged = [cell for cell in found if not cell.is_lost]
    reference = [cell for cell in found if cell.case.is_reference]
    too_far = [cell for cell in found if cell.by_schedule[FAST].is_too_far]
    too_far.sort(key=lambda cell: -cell.by_schedule[FAST].excess.value)
    rows = {"all": [_row(name, judged, times) for name in names]}
    rows["reference"] = [_row(name, reference, times) for name in names]
    enough = [row for row in rows["all"] if row.values["surely"] == 0]
    cheapest = min(enough, key=lambda row: row.values["of 20 iterations"], default=None)
    note = "cheapest schedule that is nowhere surely above 1 %: " + (cheapest.name if cheapest else "none")
    meaning = "surely: by two standard errors; worst*: at the reference cases' best strengths"
    lost = "not judged, as the spot is lost: " + ", ".join(cell.name for cell in found if cell.is_lost)
    return [
        Table("schedules", f"{len(judged)} cells", rows["all"], [note, meaning, lost], _curves(judged)),
        Table("schedules_reference", f"The reference cases, {len(reference)} cells", rows["reference"]),
        Table(
            "schedules_violations",
            f'"fast" more than {100 * ENOUGH:g} % above the converged R',
            [_cell_row(cell) for cell in too_far],
            ["*: of the strengths, the one that suits the case best"],
        ),
        Table("schedules_cells", "Every cell", [_cell_row(cell) for cell in found]),
    ]


def run(
    realisations: int = REALISATIONS, most_blocks: int = MOST_BLOCKS, seconds: float = 20.0
) -> list[Table]:
    """Measure all schedules on all cases, and all estimators' steps: 20 to 30 minutes on two cores."""
    cells = [(case, strength) for case in CASES for strength in STRENGTHS]
    found = [of_case(*cell, realisations, schedules(), most_blocks) for cell in cells]
    few = {name: settings for name, settings in schedules().items() if name in GENEROUS}
    generous = [of_case(*cell, realisations, few, generosity=2) for cell in cells]
    tables = tables_of_denoising(found, timed(seconds))
    automatic = [of_automatic(case, realisations) for case in CASES]
    tables += [
        table_of("schedules_generous", "Twice as many kept pixels", generous),
        table_of("schedules_automatic", "Automatic strength and number of kept pixels", automatic),
        table_of_nearly_infeasible(realisations, most_blocks),
    ]
    return tables + tables_of_steps(realisations)


@click.command()
@click.option("--quick", is_flag=True, help=f"{QUICK_REALISATIONS} images of each cell.")
@click.option("--pictures", type=click.Path(file_okay=False, path_type=Path), help="Folder to draw into.")
def main(quick: bool, pictures: Path | None) -> None:
    """Measure how much work is enough, and print the tables."""
    tables = run(QUICK_REALISATIONS, 1, 5.0) if quick else run()
    for table in tables:
        showing.show(table)
    if pictures is not None:
        from benchmarks.schedule_figures import write_pictures

        write_pictures({table.name: table for table in tables}, pictures)


if __name__ == "__main__":
    main()
