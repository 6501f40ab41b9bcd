"""The presets measure slopes as good as the converged denoising, with few iterations.

The benchmark `schedules` looks at many more cases; here are some, at the full noise as strength, where few
iterations do worst.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from benchmarks import schedule_cases, schedules

from faintspot import Settings
from faintspot.estimators import measure
from faintspot.presets import PRESETS

N = 8000
CONVERGED: dict[str, Any] = {"tolerance": 1e-4, "max_iterations": 500}
ENOUGH, TOLERANCE = 0.01, 0.03
"""What "fast" is for: 1 %. Of 8,000 images the excess has a standard error of 0.1 to 1 % (the spot that is
nearly lost): 1 % and two of these."""


def excess(case: schedule_cases.Case, keep: int, strength: float, **settings: Any) -> float:
    """Return (R - converged R) / converged R."""
    images, truth = schedule_cases.sample(case, N, 7)
    usual: dict[str, Any] = {"noise_std": strength * case.pixel_noise_e, "keep_brightest": keep}
    converged = measure(images, Settings(**usual, **CONVERGED))
    slopes = measure(images, Settings(**usual, **settings))
    found = schedule_cases.compared(schedule_cases.differences(slopes, converged, truth))
    return found.excess.value


@pytest.mark.parametrize(
    ("name", "keep"),
    [("rn3_f80", 12), ("rn0.1_f30", 11), ("rn0.1_f30_gauss", 16)],
    ids=["nearly infeasible", "diffraction spot", "Gaussian spot"],
)
def test_fast_is_as_good_as_converged(name: str, keep: int) -> None:
    case = next(case for case in schedule_cases.CASES if case.name == name)
    assert excess(case, keep, 1.0, preset="fast") < TOLERANCE


def test_accurate_is_as_good_as_converged_with_many_pixels_kept_and_fewer_iterations_are_not() -> None:
    """Where a wide, shallow residue is left: a large Gaussian spot, 100 of 256 pixels."""
    case = next(case for case in schedule_cases.CASES if case.name == "rn0.1_f80_gauss_size2")
    assert excess(case, 100, 0.7) < ENOUGH
    assert excess(case, 220, 0.7, preset="fast") > ENOUGH


def test_the_excess_and_its_standard_error_are_those_of_a_ratio_of_means() -> None:
    rng = np.random.default_rng(1)
    theirs = rng.exponential(1.0, 4000)
    ours = 1.02 * theirs + rng.normal(0.0, 0.1, 4000)
    found = schedule_cases.compared(np.stack([ours, theirs, np.full(4000, 0.5), np.full(4000, 8.0)]))
    assert found.excess.value == pytest.approx(ours.mean() / theirs.mean() - 1)
    # Only what is not in both counts: 0.1 px of a mean of 1 px.
    assert found.excess.standard_error == pytest.approx(0.1 / math.sqrt(4000), rel=0.1)
    assert found.distance == pytest.approx(0.5 / theirs.mean())
    assert found.is_too_far
    assert found.is_surely_too_far


def test_cases_have_names_of_their_own_and_schedules_valid_settings() -> None:
    names = [case.name for case in schedule_cases.CASES]
    assert len(set(names)) == len(names)
    assert sum(case.is_reference for case in schedule_cases.CASES) == 24
    for settings in schedules.schedules().values():
        assert Settings(noise_std=1.0, **settings).preset in PRESETS
    assert set(schedules.GENEROUS) < set(schedules.schedules())


def test_tables_say_where_fast_is_not_good_enough() -> None:
    cases = [case for case in schedule_cases.CASES if case.name in ("rn3_f200", "rn0.1_f30")]
    found = [schedules.of_case(case, 1.0, 64, schedules.schedules()) for case in cases]
    times = {name: np.linspace(1.0, 1.1, 10) for name in schedules.schedules()}
    table, reference, violations, cells = schedules.tables_of_denoising(found, times)
    assert [row.name for row in table.rows] == [row.name for row in reference.rows] == list(times)
    assert {row.name for row in violations.rows} <= {row.name for row in cells.rows}
    assert [row.name for row in cells.rows] == ["rn0.1_f30, 1", "rn3_f200, 1*"]
    assert [n for n, _ in table.curves["worst"]] == list(schedules.ITERATIONS)
