"""What arms choose: for R, and for the gain-corrected rms."""

from __future__ import annotations

import numpy as np
import pytest

from faintspot.study import StudySpecification, Sweep
from faintspot.study.arms import position_table
from faintspot.study.cell import realisations
from faintspot.study.estimator_arms import EstimatorArms
from faintspot.study.metric import slope_statistics
from faintspot.study.specification import Robustness
from faintspot.study.tuning import Tuning

SPECIFICATION = StudySpecification(
    "s",
    [Sweep("a", flux_e=30, pixels=8, d_over_r0=2)],
    realisations=400,
    arms=["plain", "gaussian", "ml"],
    widths=[0.4, 1.0],
    blurs=[0.0, 1.5],
    model_errors=[0.3],
    fixed_k=[20],
    corrected=True,
)
CELL = SPECIFICATION.cells()[0]
NAN = float("nan")
ROBUST = (Robustness(0.0, 0.3), Robustness(1.5, 0.3))


def test_choices_are_those_of_the_smallest_error() -> None:
    blocks = list(realisations(CELL, 200, np.random.default_rng(1)))
    ((images, truth),) = blocks
    tuning = Tuning(CELL, SPECIFICATION)
    estimators = EstimatorArms(CELL, 1, 1.0, 30.0)
    tuning.add(blocks, estimators)
    choices = tuning.choices()
    for arm, candidates in (("plain", [NAN]), ("gaussian", [0.4, 1.0])):
        tables = [position_table(arm, candidate, CELL, images, 1.0)[0] for candidate in candidates]
        corrected = [
            [slope_statistics(table[:, k, 0], table[:, k, 1], truth).corrected_rms.value for k in range(63)]
            for table in tables
        ]
        errors = [np.abs(table - truth[:, None]).mean(axis=(0, 2)) for table in tables]
        for mode, values in (("best", errors), ("corrected", corrected)):
            row, column = np.unravel_index(np.argmin(values), np.shape(values))
            assert choices[arm, mode].column == column, (arm, mode)
            assert choices[arm, mode].candidate == pytest.approx(candidates[int(row)], nan_ok=True)
        assert choices[arm, "fixed20"].column == 19
    slopes = [estimators.measure("ml", candidate, images) for candidate in ROBUST]
    found = [slope_statistics(s.x, s.y, truth) for s in slopes]
    best = int(np.argmin([s.error.value for s in found]))
    assert choices["ml", "best"].candidate == ROBUST[best]
    corrected_best = int(np.argmin([s.corrected_rms.value for s in found]))
    assert choices["ml", "corrected"].candidate == ROBUST[corrected_best]


def test_images_may_come_in_parts() -> None:
    whole, parts = Tuning(CELL, SPECIFICATION), Tuning(CELL, SPECIFICATION)
    estimators = EstimatorArms(CELL, 1, 1.0, 30.0)
    ((images, truth),) = realisations(CELL, 200, np.random.default_rng(2))
    whole.add([(images, truth)], estimators)
    parts.add([(images[:70], truth[:70])], estimators)
    parts.add([(images[70:], truth[70:])], estimators)
    for key, choice in whole.choices().items():
        other = parts.choices()[key]
        assert choice.column == other.column
        assert repr(choice.candidate) == repr(other.candidate)  # NaN included


def test_nothing_to_choose_needs_no_images() -> None:
    specification = StudySpecification("s", [Sweep("a")], arms=["ml", "trained"], fixed_k=[])
    choices = Tuning(specification.cells()[0], specification).choices()
    assert choices["ml", "best"].candidate == Robustness(0.0, 0.0)
    assert np.isnan(choices["trained", "best"].candidate)
