import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.experiments.night_cases import BLOCK_S, night_with, without_r0

from faintspot.base.checks import not_none
from faintspot.experiments.night.analysis import (
    ALL_STRENGTHS,
    BEST,
    FAILS,
    HOLDS,
    OPEN,
    by_strength,
    contrast,
    differences,
    drift_of_r0,
    group_means,
    groups,
    hours_needed,
    lines,
    verdicts,
)


def test_groups_leave_a_strength_of_zero_out() -> None:
    """A method without a strength is a group of its own."""
    night = night_with()
    found = groups(night)
    assert list(found) == [ALL_STRENGTHS, BEST]
    np.testing.assert_array_equal(found[ALL_STRENGTHS], night.strength > 0)
    np.testing.assert_array_equal(found[BEST], (night.strength >= 0.6) & (night.strength <= 1.1))
    labels, none = (*night.labels, "fixed window"), night.strength == 0
    changed = replace(
        night,
        labels=labels,
        settings=(*night.settings, ""),
        method=np.where(none, len(labels) - 1, night.method),
        strength=np.where(none, np.nan, night.strength),
    )
    assert list(groups(changed)) == [ALL_STRENGTHS, BEST, "fixed window"]


def test_a_known_effect_is_found_within_its_error() -> None:
    for effect in (0.12, -0.12):
        every, best = differences(night_with(1, effect=effect, best=-2 * effect))
        for found in (every, best):
            assert found.paired is not None
            assert found.paired.standard_error < found.measured.standard_error
            assert 0.003 < found.measured.standard_error < 0.05
        for each in (best.measured, not_none(best.paired)):
            assert abs(each.value + effect) < 3 * each.standard_error
        assert best.measured.decided == -np.sign(effect)


@pytest.mark.slow
def test_errors_are_those_of_repeated_nights() -> None:
    found = [differences(night_with(seed))[0].measured for seed in range(10)]
    scatter = np.std([each.value for each in found], ddof=1)
    stated = np.mean([each.standard_error for each in found])
    assert 0.5 < scatter / stated < 1.8  # 10 nights: the scatter is known to 24 %
    assert sum(each.decided != 0 for each in found) <= 3  # 0.5 are expected


@pytest.mark.slow
def test_r0_that_one_method_measures_too_large_hardly_matters() -> None:
    shifts = [
        differences(night_with(seed, bias_of_r0=0.1))[0].measured.value
        - differences(night_with(seed))[0].measured.value
        for seed in range(2)
    ]
    assert abs(np.mean(shifts)) < 0.016  # r0 as measured would shift it by -0.04


def test_the_drift_follows_r0() -> None:
    night = night_with(3)
    drift = drift_of_r0(night)
    assert drift is not None
    assert np.corrcoef(drift, np.log(night.true_r0_m))[0, 1] > 0.8
    assert drift_of_r0(without_r0(night)) is None


def test_what_is_not_known_is_left_out() -> None:
    """Without r0 the night is compared all the same; without paired runs, hours are the measured effect's."""
    night = night_with(4, effect=0.1)
    found = differences(without_r0(night))[0]
    assert found.measured == found.without_r0
    assert abs(found.measured.value - 0.1) < 3.5 * found.measured.standard_error
    assert lines(without_r0(night)) == []
    strehl = night.strehl.copy()
    strehl[[0, 20]] = np.nan
    found = differences(replace(night, strehl=strehl))[0]
    assert found.paired is not None
    assert math.isfinite(found.measured.value + found.paired.value)
    found = differences(night_with(7, effect=0.1, paired=False))[0]
    error = found.measured.standard_error
    assert found.paired is None
    assert found.hours_needed == pytest.approx(hours_needed(found.measured.value, error, found.hours))


def test_hours_are_those_of_three_standard_errors() -> None:
    for effect, error, hours, shared, needed in (
        (0.03, 0.01, 2.0, 0.0, 2.0),
        (-0.01, 0.01, 2.0, 0.0, 18.0),
        (0.0, 0.01, 2.0, 0.0, math.inf),
        (math.nan, 0.01, 2.0, 0.0, math.nan),
        (0.03, 0.02, 1.0, 0.0, 4.0),
        (0.03, math.hypot(0.02, 0.006), 1.0, 0.006, 6.25),
        (0.03, 0.02, 1.0, 0.01, math.inf),
    ):
        assert hours_needed(effect, error, hours, shared) == pytest.approx(needed, nan_ok=True)
    for effect, enough in ((0.3, True), (0.005, False)):
        assert differences(night_with(6, effect=effect))[0].is_long_enough == enough


def test_hours_of_a_group_are_those_of_its_blocks_and_of_the_reference() -> None:
    every, best = differences(night_with())
    # 8 cycles of 4 strengths and 4 of 6, of which one is 0 and one within the paper's range.
    assert [each.hours for each in (every, best)] == pytest.approx(
        [BLOCK_S / 3600 * (12 + blocks) for blocks in (8 * 3 + 4 * 5, 8 * 1 + 4 * 1)]
    )
    assert [each.blocks for each in (every, best)] == [44, 12]


def test_means_of_sets_and_a_parabola_of_the_seeing_are_removed_exactly() -> None:
    night = night_with(11)
    drift = np.log(night.true_r0_m)
    of_set = np.array([0.1, 0.25, 0.3, 0.2])[night.set_number]
    strehl = of_set + 0.2 * drift - 0.1 * drift**2 + 0.07 * (night.strength > 0)
    known = replace(night, strehl=strehl)
    reference = known.method == known.reference
    found = contrast(known, known.strength > 0, reference, drift)
    assert found.value == pytest.approx(0.07, abs=1e-9)
    assert found.standard_error < 1e-9
    assert abs(contrast(known, known.strength > 0, reference, None).value - 0.07) > 1e-4


def test_ranges_of_strengths_hold_every_strength_once() -> None:
    """One on an edge belongs to the paper's range, else to the lower range."""
    night = night_with(8, best=0.2)
    strength = night.strength.copy()
    edges = np.array([0.3, 0.4, 0.6, 1.1, 1.4, 1.6, 1.9])
    strength[strength > 0] = edges[np.arange((strength > 0).sum()) % len(edges)]
    ranges = by_strength(replace(night, strength=strength))
    expected = [np.isin(strength, part) for part in ([0.3], [0.4], [0.6, 1.1], [1.4, 1.6], [1.9])]
    assert [each.blocks for _, each in ranges] == [np.count_nonzero(rows) for rows in expected]
    assert [mean for mean, _ in ranges] == pytest.approx([strength[rows].mean() for rows in expected])
    of_night = by_strength(night)
    assert max((each.measured.value, each.name) for _, each in of_night)[1] == "0.6 to 1.1 e-"


def test_the_line_against_r0_is_least_squares() -> None:
    """Its error is that of a jackknife over cycles."""
    night = night_with(9)
    line, rows = lines(night)[0], night.method == night.reference

    def fitted(rows: NDArray[np.bool_]) -> NDArray[np.float64]:
        return np.polyfit(night.r0_m[rows], night.strehl[rows], 1)

    assert (line.slope_per_m.value, line.intercept) == pytest.approx(fitted(rows))
    assert line.correlation == pytest.approx(np.corrcoef(night.r0_m[rows], night.strehl[rows])[0, 1])
    assert line.slope_per_m.decided == 1
    for name in ("value", "standard_error", "high"):
        assert getattr(line.slope_per_cm, name) == pytest.approx(0.01 * getattr(line.slope_per_m, name))
    without = [fitted(rows & (night.cycle != each))[0] for each in range(12)]
    error = np.sqrt(11 / 12 * np.square(without - np.mean(without)).sum())
    assert line.slope_per_m.standard_error == pytest.approx(error)


def test_means_of_sets_and_of_all() -> None:
    night = night_with()
    rows = night.method == night.reference
    *of_sets, of_all = group_means(night, rows)
    assert [means["blocks"] for means in of_sets] == [4, 2, 4, 2]
    assert of_all["mean"] == pytest.approx(night.strehl[rows].mean())
    assert of_all["standard_deviation"] == pytest.approx(night.strehl[rows].std(ddof=1))
    assert of_sets[1]["mean"] == pytest.approx(night.strehl[rows & (night.set_number == 1)].mean())


def test_a_shared_error_widens_intervals_and_does_not_fall_with_time() -> None:
    night = night_with(effect=0.05)
    shared = np.where(night.method == night.reference, 0.0, 0.01)
    before, after, too_much = (
        differences(replace(night, shared_error=factor * shared))[0] for factor in (0, 1, 3)
    )
    one, other = before.measured, after.measured
    assert other.value == one.value
    assert other.standard_error == pytest.approx(math.hypot(one.standard_error, 0.01))
    assert other.high - other.value == pytest.approx(math.hypot(one.high - one.value, 1.96 * 0.01))
    assert after.hours_needed > before.hours_needed
    assert too_much.shared_error == pytest.approx(0.03)


def outcomes(*arguments: int, **options: float) -> list[tuple[str, str]]:
    found = verdicts(night_with(*arguments, **options))  # type: ignore[arg-type]
    return [(each.outcome, each.paired_outcome) for each in found]


def test_verdicts_follow_the_effect() -> None:
    """A small one is not decided by alternation but by the same turbulence."""
    assert outcomes(1, effect=0.2, best=0.2) == [(HOLDS, HOLDS)] * 3 + [(HOLDS, "")]
    assert outcomes(1, effect=-0.2, best=-0.2)[:3] == [(FAILS, FAILS)] * 3
    (every, *_) = verdicts(night_with(0, effect=-0.02))
    assert (every.outcome, every.paired_outcome) == (OPEN, FAILS)
    assert abs(every.significance) < 3
    assert every.hours_needed > 2 * night_with(0).hours
    unpaired = outcomes(3, effect=0.2, paired=False)
    assert {paired for _, paired in unpaired} == {""}
    assert unpaired[0][0] == HOLDS
    night = night_with(4)
    assert verdicts(replace(night, strength=np.full(len(night.strehl), np.nan))) == []


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
