"""What methods choose: for R, and for the gain-corrected rms."""

from __future__ import annotations

import numpy as np

from faintspot.base.statistics import slope_statistics
from faintspot.experiments import StudySpecification, Sweep
from faintspot.experiments.study.cell import Tuning, realisations
from faintspot.experiments.study.cell_methods import CellMethods, position_table

SPECIFICATION = StudySpecification(
    "s",
    [Sweep("a", flux_e=30, pixels=8, d_over_r0=2)],
    realisations=400,
    estimators=["brightest", "smoothed", "ml"],
    widths=[0.4, 1.0],
    blurs=[0.0, 1.5],
    model_errors=[0.3],
    fixed_k=[20],
    corrected=True,
)
CELL = SPECIFICATION.cells()[0]
METHODS = CellMethods(CELL, SPECIFICATION, 30.0)


def tuning() -> Tuning:
    return Tuning(METHODS)


def test_choices_are_those_of_the_smallest_error() -> None:
    blocks = list(realisations(CELL, 200, np.random.default_rng(1)))
    ((images, truth),) = blocks
    search = tuning()
    search.add(blocks)
    choices = search.choices()
    for method in ("brightest", "smoothed"):
        candidates = METHODS.candidates(method)
        tables = [position_table(METHODS.estimator(method, c), images, 1.0)[0] for c in candidates]  # type: ignore[arg-type]
        corrected = [
            [slope_statistics(table[:, k, 0], table[:, k, 1], truth).corrected_rms.value for k in range(63)]
            for table in tables
        ]
        errors = [np.abs(table - truth[:, None]).mean(axis=(0, 2)) for table in tables]
        for mode, values in (("best", errors), ("corrected", corrected)):
            row, column = np.unravel_index(np.argmin(values), np.shape(values))
            assert choices[method, mode].column == column, (method, mode)
            assert choices[method, mode].candidate == candidates[int(row)]
        assert choices[method, "fixed20"].column == 19
    robust = METHODS.candidates("ml")
    slopes = [METHODS.measure("ml", candidate, images) for candidate in robust]
    found = [slope_statistics(s.x, s.y, truth) for s in slopes]
    best = int(np.argmin([s.error.value for s in found]))
    assert choices["ml", "best"].candidate == robust[best]
    corrected_best = int(np.argmin([s.corrected_rms.value for s in found]))
    assert choices["ml", "corrected"].candidate == robust[corrected_best]


def test_images_may_come_in_parts() -> None:
    whole, parts = tuning(), tuning()
    ((images, truth),) = realisations(CELL, 200, np.random.default_rng(2))
    whole.add([(images, truth)])
    parts.add([(images[:70], truth[:70])])
    parts.add([(images[70:], truth[70:])])
    assert whole.choices() == parts.choices()


def test_nothing_to_choose_needs_no_images() -> None:
    specification = StudySpecification("s", [Sweep("a")], estimators=["ml", "trained"], fixed_k=[])
    methods = CellMethods(specification.cells()[0], specification)
    choices = Tuning(methods).choices()
    assert choices["ml", "best"].candidate == (("blur_px", 0.0), ("model_error", 0.0))
    assert choices["trained", "best"].candidate == ()
