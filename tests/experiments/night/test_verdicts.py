from dataclasses import replace

import numpy as np
import pytest
from tests.experiments.night_cases import BLOCK_S, night_with

from faintspot.experiments.night.analysis import FAILS, HOLDS, OPEN, lines, verdicts


def outcomes(*arguments: int, **options: float) -> list[tuple[str, str]]:
    found = verdicts(night_with(*arguments, **options))  # type: ignore[arg-type]
    return [(each.outcome, each.paired_outcome) for each in found]


def test_a_night_that_confirms_the_paper() -> None:
    assert outcomes(1, effect=0.2, best=0.2) == [(HOLDS, HOLDS)] * 3 + [(HOLDS, "")]


def test_a_night_that_contradicts_it() -> None:
    assert outcomes(1, effect=-0.2, best=-0.2)[:3] == [(FAILS, FAILS)] * 3


def test_a_small_effect_is_not_decided_by_alternation_but_by_the_same_turbulence() -> None:
    (every, *_) = verdicts(night_with(0, effect=-0.02))
    assert (every.outcome, every.paired_outcome) == (OPEN, FAILS)
    assert abs(every.significance) < 3
    assert every.hours_needed > 2 * night_with(0).hours


def test_best_strengths_are_compared_with_all_others() -> None:
    """The others are the 32 blocks of TV outside the range, not the reference."""
    night = night_with(2, effect=0.1, best=0.2)
    _, _, found, line = verdicts(night)
    for estimate in (found.measured, found.paired):
        assert abs(estimate.value - 0.2) < 3 * estimate.standard_error
    assert found.paired.standard_error < 0.02  # noise of 0.028 in each of 12 and of 32 blocks
    assert found.significance == pytest.approx(found.measured.value / found.measured.standard_error)
    hours = 44 * BLOCK_S / 3600
    error = found.measured.standard_error
    assert found.hours_needed == pytest.approx(hours * (3 * error / found.paired.value) ** 2)
    slope = lines(night)[0].slope_per_m
    needed = 68 * BLOCK_S / 3600 * (3 * slope.standard_error / slope.value) ** 2
    assert line.hours_needed == pytest.approx(needed)
    assert line.unit == " per cm"


def test_without_paired_runs_there_is_no_paired_verdict() -> None:
    found = verdicts(night_with(3, effect=0.2, paired=False))
    assert {each.paired_outcome for each in found} == {""}
    assert found[0].outcome == HOLDS


def test_a_night_without_strengths_has_no_verdicts() -> None:
    night = night_with(4)
    assert verdicts(replace(night, strength=np.full(len(night.strehl), np.nan))) == []
