"""The slope error R and what else describes slopes, against what is known in closed form."""

from typing import Any

import numpy as np
import pytest
from tests.refusals import refused

from faintspot.base.statistics import (
    Estimate,
    absolute_errors,
    mean_by_blocks,
    of_draws,
    paired_mean,
    slope_error,
    slope_statistics,
)


def test_slope_error_is_the_mean_of_both_axes() -> None:
    rng = np.random.default_rng(1)
    x, y, truth = rng.normal(size=(7, 5)), rng.normal(size=(7, 5)), rng.normal(size=(7, 5, 2))
    terms = (np.abs(x - truth[..., 0]) + np.abs(y - truth[..., 1])) / 2
    np.testing.assert_allclose(absolute_errors(x, y, truth), terms, rtol=1e-14)
    assert slope_error(x, y, truth).value == pytest.approx(terms.mean(), rel=1e-14)
    assert slope_error(x, y, truth).standard_error == pytest.approx(terms.std() / np.sqrt(35), rel=1e-14)
    assert slope_error(1.0, 2.0, (0.0, 0.0)).value == 1.5


def test_float32_positions_do_not_lose_digits_of_the_truth() -> None:
    assert (
        absolute_errors(np.array([0.5], np.float32), np.array([0.5], np.float32), [[0.5 + 1e-9, 0.5]])[0] > 0
    )


def test_positions_of_wrong_shape_are_refused() -> None:
    for x, y, truth, words in (
        (np.ones(3), np.ones(3), np.ones(3), "truth: expected shape (3, 2)"),
        (np.ones(3), np.ones(3), np.ones((2, 2)), "truth: expected shape (3, 2)"),
        (np.full(3, np.nan), np.ones(3), np.ones((3, 2)), "x: expected finite numbers"),
        ([], [], np.ones((0, 2)), "at least one value"),
        (np.ones(3), np.ones(3), np.full((3, 2), np.inf), "truth: expected finite numbers"),
    ):
        for function in (slope_error, slope_statistics):
            with refused(words):
                function(x, y, truth)


def test_standard_error_of_r_covers_the_truth() -> None:
    """The mean of (|dx| + |dy|) / 2 of unit normal errors is sqrt(2 / pi).

    2000 experiments of 200 slopes: the fraction within one standard error is binomial with p = 0.683; 4.9
    standard deviations (0.051) allow a false alarm in 1e6, and skewness at 200 slopes moves p by < 0.01.
    """
    errors = np.random.default_rng(2).normal(size=(2000, 200, 2))
    estimates = [slope_error(e[:, 0], e[:, 1], np.zeros((200, 2))) for e in errors]
    deviations = np.array([(e.value - np.sqrt(2 / np.pi)) / e.standard_error for e in estimates])
    assert abs(np.mean(np.abs(deviations) < 1) - 0.683) < 0.061


def gained(n: int, seed: int, gain: float = 0.6, noise: float = 0.2) -> tuple[Any, Any]:
    rng = np.random.default_rng(seed)
    truth = rng.uniform(-1, 1, (n, 2))
    return gain * truth + (0.1, -0.2) + rng.normal(0, noise, (n, 2)), truth


def test_statistics_of_a_known_estimator() -> None:
    """gain 0.6, offsets 0.1 and -0.2, noise 0.2 px: 5 standard errors, 6e-7 for each of them."""
    found, truth = gained(20_000, 1)
    statistics = slope_statistics(found[:, 0], found[:, 1], truth)
    expected = {"gain": 0.6, "rms": np.sqrt(0.16 / 3 + 0.04 + 0.025), "corrected_rms": 0.2 / 0.6}
    for name, value in expected.items():
        estimate = getattr(statistics, name)
        assert abs(estimate.value - value) < 5 * estimate.standard_error, name
        assert estimate.standard_error < 0.01
    assert statistics.error == slope_error(found[:, 0], found[:, 1], truth)


def test_standard_errors_of_statistics_are_the_spread() -> None:
    """Over 300 experiments: the spread is known to 4 %; 5 of those are 20 %."""
    samples = [gained(400, seed) for seed in range(300)]
    every = [slope_statistics(found[:, 0], found[:, 1], truth) for found, truth in samples]
    for name in ("error", "gain", "rms", "corrected_rms"):
        spread = np.std([getattr(s, name).value for s in every])
        stated = np.mean([getattr(s, name).standard_error for s in every])
        assert stated == pytest.approx(spread, rel=0.2), name


def test_falling_back_to_the_centre_is_seen() -> None:
    """R alone prefers no estimate at all to a noisy one; gain and corrected rms do not."""
    rng = np.random.default_rng(3)
    truth = rng.uniform(-1, 1, (1000, 2))
    nothing = slope_statistics(np.zeros(1000), np.zeros(1000), truth)
    noisy_slopes = truth + rng.normal(0, 0.7, truth.shape)
    noisy = slope_statistics(noisy_slopes[:, 0], noisy_slopes[:, 1], truth)
    assert nothing.error.value < noisy.error.value
    assert nothing.gain.value == 0.0
    assert nothing.corrected_rms.value == np.inf
    assert nothing.outlier_fraction.value == 0.0


def test_outliers_are_beyond_the_limit_on_either_axis() -> None:
    x, y = np.array([0.0, 1.5, 0.0, 0.9]), np.array([0.0, 0.0, -2.0, 0.9])
    truth = np.zeros((4, 2))
    assert slope_statistics(x, y, truth).outlier_fraction.value == 0.5
    assert np.isnan(slope_statistics(x, y, truth).gain.value)  # the truth does not vary


def test_perfect_slopes_have_gain_one_and_no_error() -> None:
    truth = np.random.default_rng(4).uniform(-1, 1, (2, 5, 2))
    statistics = slope_statistics(truth[..., 0], truth[..., 1], truth)
    assert statistics.gain.value == pytest.approx(1.0)
    assert statistics.corrected_rms.value == pytest.approx(0.0, abs=1e-12)
    assert statistics.rms.value == 0.0


def test_an_estimate_has_an_interval() -> None:
    estimate = Estimate(1.0, 0.5)
    np.testing.assert_allclose([estimate.low, estimate.high], [0.02, 1.98], atol=1e-3)
    assert estimate.decided == 1
    assert Estimate(-1.0, 0.4).decided == -1
    assert Estimate(1.0, 0.6).decided == 0
    assert np.isnan(Estimate(1.0).low)
    assert Estimate(1.0).decided == 0


def test_interval_of_a_mean_is_student_s() -> None:
    values = np.random.default_rng(5).normal(0.3, 1, 6)
    found = paired_mean([*values, np.nan])
    half = 2.5706 * values.std(ddof=1) / np.sqrt(6)  # t of 5 degrees of freedom
    assert found.value == pytest.approx(values.mean())
    assert found.standard_error == pytest.approx(values.std(ddof=1) / np.sqrt(6))
    assert (found.low, found.high) == pytest.approx((values.mean() - half, values.mean() + half), rel=1e-4)
    assert found.count == 6
    wider = paired_mean(values, comparisons=10)
    assert wider.low < found.low < found.high < wider.high
    assert np.isnan(paired_mean([]).value)
    assert np.isnan(paired_mean([1.0]).low)


def test_blocks_widen_the_interval_of_a_slow_series() -> None:
    slow = np.repeat(np.random.default_rng(6).normal(size=300), 10)
    by_value, by_block = mean_by_blocks(slow), mean_by_blocks(slow, 10)
    assert by_block.standard_error > 2 * by_value.standard_error
    # 10 neighbours are one value; blocks that begin within one share it, which narrows by up to a fifth.
    assert by_block.standard_error == pytest.approx(slow[::10].std(ddof=1) / np.sqrt(300), rel=0.25)
    assert np.isnan(mean_by_blocks([1.0, 2.0]).low)


def test_interval_of_few_blocks_is_as_wide_as_student_s() -> None:
    """2000 draws know their scatter to 1.6 %, and their outer quantiles to 4 %."""
    values = np.random.default_rng(8).normal(size=12)
    found, error = mean_by_blocks(values), values.std(ddof=1) / np.sqrt(12)
    assert found.value == pytest.approx(values.mean())
    assert found.standard_error == pytest.approx(error, rel=0.06)
    assert (found.high - found.low) / 2 == pytest.approx(2.201 * error, rel=0.15)  # t of 11 degrees
    ten = mean_by_blocks(values, comparisons=10)
    assert (ten.high - ten.low) / (found.high - found.low) == pytest.approx(3.497 / 2.201, rel=1e-3)


def test_draws_that_leave_what_is_measured_leave_the_interval_open() -> None:
    drawn = np.concatenate([np.random.default_rng(7).normal(size=900), np.full(100, np.inf)])
    found = of_draws(0.0, drawn, 1000)
    assert found.high == np.inf
    assert np.isfinite([found.low, found.standard_error]).all()
