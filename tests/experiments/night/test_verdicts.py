from dataclasses import replace

import numpy as np
from tests.experiments.night_cases import night_with

from faintspot.experiments.night.analysis import FAILS, HOLDS, OPEN, verdicts


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


def test_without_paired_runs_there_is_no_paired_verdict() -> None:
    found = verdicts(night_with(3, effect=0.2, paired=False))
    assert {each.paired_outcome for each in found} == {""}
    assert found[0].outcome == HOLDS


def test_a_night_without_strengths_has_no_verdicts() -> None:
    night = night_with(4)
    assert verdicts(replace(night, strength_e=np.full(len(night.strehl), np.nan))) == []
