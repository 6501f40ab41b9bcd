import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import ArrayLike, NDArray
from tests.experiments.result_cases import made_up_magnitude

from faintspot.base.statistics import mean_by_blocks
from faintspot.experiments.closed_loop.results import (
    differences_by_flux,
    falling,
    gains_in_magnitude,
    magnitude_gain,
    magnitude_limit,
)
from faintspot.experiments.methods import crossings

MAGNITUDES = np.linspace(8.0, 13.0, 6)
numbers = arrays(np.float64, st.integers(1, 12), elements=st.floats(-1, 1))


def _crossed(magnitudes: ArrayLike, strehl: ArrayLike, level: float, **options: bool) -> NDArray[np.float64]:
    return crossings(np.asarray(magnitudes, np.float64), falling(strehl), level, **options)


def curves(shift: float, realisations: int = 6, scatter: float = 0.02) -> np.ndarray:
    atmosphere = np.random.default_rng(2).normal(0, scatter, realisations)  # the same for every method
    return 0.7 - 0.1 * (MAGNITUDES[:, None] - shift - 8) + atmosphere


@given(numbers)
def test_falling_curves_never_rise_and_keep_their_mean(values: np.ndarray) -> None:
    found = falling(values)
    assert (np.diff(found) <= 1e-12).all()
    assert found.mean() == pytest.approx(values.mean(), abs=1e-9)
    np.testing.assert_allclose(falling(found), found, atol=1e-12)


def test_a_curve_that_falls_stays_as_it_is() -> None:
    np.testing.assert_array_equal(falling([3.0, 2.0, 2.0, 1.0]), [3, 2, 2, 1])


@given(numbers)
def test_falling_is_pool_adjacent_violators(values: np.ndarray) -> None:
    pools: list[list[float]] = []
    for value in values:
        pools.append([float(value)])
        while len(pools) > 1 and np.mean(pools[-2]) < np.mean(pools[-1]):
            pools[-2:] = [pools[-2] + pools[-1]]
    expected = np.concatenate([[np.mean(pool)] * len(pool) for pool in pools])
    np.testing.assert_allclose(falling(values), expected, atol=1e-9)


def test_many_curves_at_once_are_as_one_by_one() -> None:
    many = np.random.default_rng(9).uniform(0, 1, (50, 6))
    np.testing.assert_allclose(falling(many), [falling(one) for one in many])
    together = _crossed(MAGNITUDES, many, 0.5)
    np.testing.assert_allclose(together, [_crossed(MAGNITUDES, one, 0.5) for one in many])


def test_the_limiting_magnitude_lies_between_points() -> None:
    assert _crossed([8, 9, 10], [0.6, 0.5, 0.3], 0.4, straight=True) == pytest.approx(9.5)
    assert _crossed([8, 9, 10], [0.5, 0.4, 0.3], 0.35) == pytest.approx(9.5)
    assert _crossed([8, 9, 10], [0.6, 0.5, 0.3], 0.5) == pytest.approx(9.0)
    assert _crossed([8, 9], [0.6, 0.5], 0.4) == math.inf
    assert _crossed([8, 9], [0.3, 0.2], 0.4) == -math.inf


@pytest.mark.parametrize("apart", [0.5, 1.0, 1.5])
def test_limits_of_curves_that_bend_hold_within_their_errors(apart: float) -> None:
    """A third of the error of straight lines, which is the error that is stated."""
    wrong, stated, straight = [], [], []
    for middle in np.linspace(10.0, 11.0, 9):
        for level in (0.15, 0.3, 0.45):
            faint = np.arange(7.0, 14.5, apart)
            strehl = 0.6 / (1 + np.exp((faint - middle) / 0.7))
            truth = middle + 0.7 * np.log(0.6 / level - 1)
            limit = magnitude_limit(faint, np.tile(strehl[:, None], 6), level)
            wrong.append(limit.magnitude.value - truth)
            stated.append(limit.estimate.standard_error)
            straight.append(float(_crossed(faint, strehl, level, straight=True)) - truth)
    rms, of_lines = (float(np.sqrt(np.square(errors).mean())) for errors in (wrong, straight))
    assert rms < 0.6 * of_lines
    assert rms < float(np.sqrt(np.square(stated).mean())) < 1.5 * of_lines


def test_a_gain_between_curves_that_bend_differently_is_not_that_of_lines() -> None:
    """Stars 1.5 magnitudes apart: lines are wrong by more than the error, which both results state."""
    faint = np.arange(7.0, 14.5, 1.5)
    one, other = (0.6 / (1 + np.exp((faint - middle) / 0.5)) for middle in (11.0, 10.25))
    runs, others = (np.tile(curve[:, None], 6) for curve in (one, other))
    gain = magnitude_gain(faint, runs, others, 0.15)
    assert gain.interpolation_error > 0.02
    assert abs(gain.magnitude.value - 0.75) < 2 * gain.interpolation_error
    found = gain.estimate
    assert found.low < 0.75 < found.high


def test_two_stars_show_no_bend_and_the_interval_says_so() -> None:
    faint = [9.0, 10.5]
    one, other = (0.6 / (1 + np.exp((np.array(faint) - middle) / 0.5)) for middle in (10.4, 9.8))
    runs, others = (np.tile(curve[:, None], 6) for curve in (one, other))
    found = magnitude_gain(faint, runs, others, 0.35).estimate
    assert found.standard_error == pytest.approx(1.5 * math.sqrt(2 / 12))
    assert found.low < 0.6 < found.high
    assert abs(found.value - 0.6) > 0.05


def test_the_gain_is_the_shift_between_two_curves() -> None:
    # Straight lines moved by 0.3 mag; air that is common to both moves them together.
    found = magnitude_gain(MAGNITUDES, curves(0.3), curves(0.0), 0.45).estimate
    assert found.value == pytest.approx(0.3)
    assert found.low == pytest.approx(0.3)
    assert found.high == pytest.approx(0.3)
    assert found.decided == 1


def test_the_order_of_magnitudes_does_not_matter() -> None:
    one = magnitude_gain(MAGNITUDES, curves(0.3), curves(0.0), 0.45)
    other = magnitude_gain(MAGNITUDES[::-1], curves(0.3)[::-1], curves(0.0)[::-1], 0.45)
    assert one == other


def test_a_gain_beyond_what_was_measured_is_not_made_up() -> None:
    assert magnitude_gain(MAGNITUDES, curves(3.0), curves(0.0), 0.35).magnitude.value == math.inf
    assert magnitude_gain(MAGNITUDES, curves(0.0), curves(3.0), 0.35).magnitude.value == -math.inf
    assert math.isnan(magnitude_gain(MAGNITUDES, curves(3.0), curves(3.0), 0.35).magnitude.value)


def test_an_interval_that_leaves_the_magnitudes_is_open() -> None:
    found = magnitude_gain(MAGNITUDES, curves(0.9, scatter=0.1), curves(0.0, scatter=0.0), 0.31).estimate
    assert math.isfinite(found.value)
    assert found.high == math.inf


def test_two_realisations_give_no_interval() -> None:
    found = magnitude_gain(MAGNITUDES, curves(0.3, 2), curves(0.0, 2), 0.45).estimate
    assert found.value == pytest.approx(0.3)
    assert math.isnan(found.low)


def test_what_is_not_measured_yet_is_left_out() -> None:
    missing = curves(0.3)
    missing[0, 2] = np.nan
    found = magnitude_gain(MAGNITUDES, missing, curves(0.0), 0.45).magnitude
    assert found.value == pytest.approx(0.3)
    assert math.isnan(magnitude_gain(MAGNITUDES, missing * np.nan, curves(0.0), 0.45).magnitude.value)


def test_block_intervals_hold_as_often_as_they_say() -> None:
    # 300 series of 40 values: 95 % holds within 4 % (three standard errors), and narrow series are honest.
    rng = np.random.default_rng(8)
    inside = 0
    for _ in range(300):
        found = mean_by_blocks(rng.normal(1.0, 0.5, 40), 1, rng)
        inside += found.low <= 1.0 <= found.high
    assert 0.91 <= inside / 300 <= 0.99


def test_gains_in_magnitude_are_those_of_the_curves() -> None:
    result = made_up_magnitude(0.3)
    gains = gains_in_magnitude(result, 1, 0)
    assert list(gains)[:2] == [0.05, 0.1]
    assert gains[0.3].value == pytest.approx(0.3, abs=0.05)
    assert gains[0.3].decided == 1


def test_differences_by_flux_are_paired() -> None:
    result = made_up_magnitude(0.3)
    for estimate, runs in zip(
        differences_by_flux(result, 1, 0), result.strehl[1] - result.strehl[0], strict=True
    ):
        assert estimate.value == pytest.approx(runs.mean())
        assert estimate.high - estimate.low < 0.02  # the air's 0.02 is common to both
