import math
from dataclasses import replace

import numpy as np
import pytest
from tests.experiments.night_cases import night_with

from faintspot.base.statistics import Estimate
from faintspot.experiments.night.paper import (
    PAPER_MEANS,
    PAPER_SCATTERS,
    _synthetic_strehl,
    agreement,
    chances_without_difference,
    compare_with_paper,
    paper_exposures,
    set_differences,
)
from faintspot.experiments.night.protocol import Night, NightPlan

PAPER_PLAN = NightPlan(gap_frames=0)


def test_differences_of_table_1_by_hand() -> None:
    """8 strengths from 0 to 2: 7 above 0 and one in 0.6 to 1.1; of 20, 19 and five. All twice."""
    exposures = paper_exposures()
    np.testing.assert_array_equal(exposures, [[2, 14, 2], [2, 38, 10]] * 2)
    # Pooled by hand: without TV (0.1, 1.2, 1.5, 1.6 %) one degree of freedom a set.
    none = math.sqrt((0.1**2 + 1.2**2 + 1.5**2 + 1.6**2) / 4)
    tv = math.sqrt((13 * 1.8**2 + 37 * 1.3**2 + 13 * 1.1**2 + 37 * 1.8**2) / 100)
    ranged = math.sqrt((1.6**2 + 9 * 2.0**2 + 0.4**2 + 9 * 1.2**2) / 20)
    every, best = set_differences(PAPER_MEANS, PAPER_SCATTERS, exposures)
    for found, values, scatter, counts in (
        (every, [0.004, 0.002, 0.005, 0.004], tv, exposures[:, 1]),
        (best, [0.016, 0.011, 0.011, 0.010], ranged, exposures[:, 2]),
    ):
        assert [each.value for each in found] == pytest.approx(values, abs=1e-12)
        errors = 0.01 * np.hypot(none / 2**0.5, scatter / np.sqrt(counts))
        assert [each.standard_error for each in found] == pytest.approx(errors)


def test_chi_square_by_hand() -> None:
    one = [Estimate(0.0, 0.3), Estimate(1.0, 0.0), Estimate(0.0, 1.0), Estimate(2.0, 1.0)]
    other = [Estimate(0.5, 0.4), Estimate(1.0, 2.0), Estimate(1.0, 0.0), Estimate(2.0, 1.0)]
    square, probability = agreement(one, other)
    assert square == pytest.approx(0.5**2 / 0.5**2 + 0 + 1 + 0)
    # For four degrees of freedom the upper tail is exp(-x / 2) (1 + x / 2).
    assert probability == pytest.approx(math.exp(-1.0) * 2.0)


def steady(scatter: float, seed: int = 0) -> Night:
    """A night of the paper's protocol without drift and without differences."""
    night = night_with(seed, plan=PAPER_PLAN)
    rng = np.random.default_rng(seed)
    flat, count = np.full(len(night.strehl), 0.15), len(night.strehl)
    strehl = 0.2 + scatter * rng.standard_normal(count)
    return replace(night, strehl=strehl, paired_strehl=strehl, r0_m=flat, true_r0_m=flat)


def test_chances_are_those_of_normal_scatter() -> None:
    """Without drift means are normal, with known errors; 1,000 nights know a share of 0.16 to 0.012."""
    night, scatter = steady(0.03), 0.03
    counts = paper_exposures()
    errors = [scatter * math.sqrt((1 / counts[:, column] + 1 / counts[:, 0]).sum()) / 4 for column in (1, 2)]
    every, best, any_range = chances_without_difference(night, errors)  # one standard error each
    # The scatter of 120 blocks is known to 7 %, which moves the share by 0.017.
    assert [every, best] == pytest.approx([0.159] * 2, abs=3 * math.hypot(0.012, 0.017))
    assert any_range > best
    for least, chance in ((-1.0, 1.0), (1.0, 0.0)):
        assert chances_without_difference(night, [least] * 2) == (chance, chance, chance)
    # Scatter below the paper's is raised to it.
    pooled = math.sqrt(((counts[:, :2] - 1) * PAPER_SCATTERS[:, :2] ** 2).sum() / (counts[:, :2] - 1).sum())
    share = chances_without_difference(steady(1e-4), [pooled / scatter * errors[0], 1.0])[0]
    assert share == pytest.approx(0.159, abs=3 * 0.012)


def test_synthetic_nights_scatter_as_the_papers_and_drift_by_its_share() -> None:
    """1,000 nights of 120 exposures: variances are known to 1 %, that of the drift to what it differs by."""
    night = steady(1e-3)
    r0 = 0.15 * np.exp(0.1 * np.sin(np.arange(len(night.strehl)) / 5))  # several periods in each set
    night = replace(night, r0_m=r0, true_r0_m=r0, strehl=night.strehl + np.log(r0))
    nights = _synthetic_strehl(night, 1000, np.random.default_rng(1))
    counts = paper_exposures()[:, :2]
    of_paper = ((counts - 1) * PAPER_SCATTERS[:, :2] ** 2).sum() / (counts - 1).sum()
    within = np.mean([nights[:, night.set_number == number].var(axis=1) for number in range(4)])
    # Of 18 and 42 exposures, the variance about the mean lacks one part in 18 and in 42.
    assert within == pytest.approx(of_paper * (1 - 0.86 * np.mean([1 / 18, 1 / 42])), rel=0.02)
    # Neighbours share the drift but not the scatter.
    spread = nights - nights.mean(axis=1, keepdims=True)
    share = (spread[:, 1:] * spread[:, :-1]).mean() / of_paper
    assert share == pytest.approx(0.38**2, abs=0.03)


def test_a_night_beside_the_paper() -> None:
    """Differences of the synthetic night are 0.02; scatter by chance allows it 4 standard errors."""
    night = night_with(1, plan=PAPER_PLAN)
    assert compare_with_paper(replace(night, strength=np.full(len(night.strehl), np.nan))) is None
    one_set = replace(night, set_names=night.set_names[:1], set_number=0 * night.set_number)
    assert compare_with_paper(one_set) is None
    night = replace(night, strehl=steady(0.012, 3).strehl + np.where(night.strength > 0, 0.02, 0.0))
    compared = compare_with_paper(night)
    assert compared is not None
    every = compared.every
    assert abs(every.our_mean.value - 0.02) < 4 * every.our_mean.standard_error
    assert every.paper_mean.value == pytest.approx(0.00375)
    assert (every.chi_square, every.probability) == agreement(every.paper, every.ours)
    assert every.paired is not None
    assert every.above_paired == pytest.approx(
        (0.00375 - every.paired.value)
        / math.sqrt(every.paper_mean.standard_error**2 + every.paired.standard_error**2)
    )
    assert 0.02 < every.chance < 0.6
    assert compared.chance_of_any >= compared.best.chance
    none, tv = (night.strehl[rows & (night.set_number == 2)].mean() for rows in
                (night.method == 0, night.strength > 0))  # fmt: skip
    assert every.ours[2].value == pytest.approx(tv - none)
