"""How many steps the estimators that know the spot need: R against that of many more steps.

"weighted" moves its weight; "matched" and "ml" make Fisher-scoring steps from the smoothed image's peak,
"map" from the posterior's mean. Nothing iterates in "brightest", "centroid", "thresholded" and "smoothed" (a
single convolution, whose taps are cut where the Gaussian has ended); the passes of "trained" are trained one
after the other, so that their number is part of the score.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

import faintspot as fs
from benchmarks.measuring import Row, Table
from benchmarks.schedule_cases import CASES, Case, Compared, compared, differences, psf_of, sample
from faintspot.estimators import measure

STEPS: dict[str, tuple[int, ...]] = {
    "weighted": (1, 2, 3, 4, 5, 6, 8, 12, 16, 24),
    "matched": (1, 2, 3, 4, 6, 8),
    "ml": (1, 2, 3, 4, 6, 8),
    "map": (1, 2, 3, 4, 6, 8),
}
CONVERGED_STEPS = 100
NEAR, WINDOW = "range of true positions", "whole window"


@dataclass(frozen=True)
class Steps:
    """One estimator on one case within one search range: R of the converged one, and all numbers of steps."""

    case: Case
    reach: str
    converged_px: float
    by_steps: dict[int, Compared]


def of_case(case: Case, estimator: str, reach: str, realisations: int) -> Steps:
    """Measure an estimator with few and with many steps on the same images."""
    cell = case.cell
    images, truth = sample(case, realisations, [c.name for c in CASES].index(case.name), 1)
    psf = psf_of(case)
    known: dict[str, Any] = {"estimator": estimator, "flux_e": cell.flux_e}
    if reach == NEAR:
        known["search_range_px"] = cell.position_range_px
    calibration = fs.Calibration(read_noise_e=cell.read_noise_e)

    def slopes(steps: int) -> fs.Slopes:
        return measure(images, fs.Settings(steps=steps, **known), calibration=calibration, psf=psf)

    converged = slopes(CONVERGED_STEPS)
    found = {steps: differences(slopes(steps), converged, truth) for steps in STEPS[estimator]}
    error = float(next(iter(found.values()))[1].mean())
    return Steps(case, reach, error, {steps: compared(each) for steps, each in found.items()})


def _row(estimator: str, steps: int, found: list[Steps]) -> Row:
    each = [cell.by_steps[steps] for cell in found]
    worst = max(found, key=lambda cell: cell.by_steps[steps].excess.value)
    excess = worst.by_steps[steps].excess
    values = {
        "worst %": 100 * excess.value,
        "+- %": 100 * excess.standard_error,
        "median %": 100 * float(np.median([one.excess.value for one in each])),
        "> 1 %": float(sum(one.is_too_far for one in each)),
        "surely": float(sum(one.is_surely_too_far for one in each)),
        "largest distance": max(one.distance for one in each),
    }
    return Row(f"{estimator}, {steps}: worst in {worst.case.name}", values)


def tables_of_steps(realisations: int) -> list[Table]:
    """Measure all estimators; one table for each search range."""
    tables = []
    for name, reach in (("near", NEAR), ("window", WINDOW)):
        rows = []
        for estimator, steps in STEPS.items():
            found = [of_case(case, estimator, reach, realisations) for case in CASES]
            rows += [_row(estimator, number, found) for number in steps]
        title = f"Steps of the estimators, positions sought in the {reach}"
        tables.append(Table(f"schedules_steps_{name}", title, rows))
    return tables
