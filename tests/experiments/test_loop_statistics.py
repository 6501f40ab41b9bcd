from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from tests.experiments.result_cases import made_up_magnitude

from faintspot.base.statistics import mean_by_blocks
from faintspot.experiments.closed_loop.results import (
    differences_by_flux,
    falling,
    gains_in_magnitude,
    limiting_magnitudes,
    magnitude_gain,
)

MAGNITUDES = np.linspace(8.0, 13.0, 6)
numbers = arrays(np.float64, st.integers(1, 12), elements=st.floats(-1, 1))


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
    together = limiting_magnitudes(MAGNITUDES, many, 0.5)
    np.testing.assert_allclose(together, [limiting_magnitudes(MAGNITUDES, one, 0.5) for one in many])


def test_the_limiting_magnitude_lies_on_the_line_between_points() -> None:
    assert limiting_magnitudes([8, 9, 10], [0.6, 0.5, 0.3], 0.4) == pytest.approx(9.5)
    assert limiting_magnitudes([8, 9], [0.6, 0.5], 0.4) == math.inf
    assert limiting_magnitudes([8, 9], [0.3, 0.2], 0.4) == -math.inf


def test_the_gain_is_the_shift_between_two_curves() -> None:
    # Straight lines moved by 0.3 mag; air that is common to both moves them together.
    found = magnitude_gain(MAGNITUDES, curves(0.3), curves(0.0), 0.45)
    assert found.value == pytest.approx(0.3)
    assert found.low == pytest.approx(0.3)
    assert found.high == pytest.approx(0.3)
    assert found.decided == 1


def test_the_order_of_magnitudes_does_not_matter() -> None:
    one = magnitude_gain(MAGNITUDES, curves(0.3), curves(0.0), 0.45)
    other = magnitude_gain(MAGNITUDES[::-1], curves(0.3)[::-1], curves(0.0)[::-1], 0.45)
    assert one == other


def test_a_gain_beyond_what_was_measured_is_not_made_up() -> None:
    found = magnitude_gain(MAGNITUDES, curves(3.0), curves(0.0), 0.35)
    assert found.value == math.inf
    assert magnitude_gain(MAGNITUDES, curves(0.0), curves(3.0), 0.35).value == -math.inf
    assert math.isnan(magnitude_gain(MAGNITUDES, curves(3.0), curves(3.0), 0.35).value)


def test_an_interval_that_leaves_the_magnitudes_is_open() -> None:
    found = magnitude_gain(MAGNITUDES, curves(0.9, scatter=0.1), curves(0.0, scatter=0.0), 0.31)
    assert math.isfinite(found.value)
    assert found.high == math.inf


def test_two_realisations_give_no_interval() -> None:
    found = magnitude_gain(MAGNITUDES, curves(0.3, 2), curves(0.0, 2), 0.45)
    assert found.value == pytest.approx(0.3)
    assert math.isnan(found.low)


def test_what_is_not_measured_yet_is_left_out() -> None:
    missing = curves(0.3)
    missing[0, 2] = np.nan
    assert magnitude_gain(MAGNITUDES, missing, curves(0.0), 0.45).value == pytest.approx(0.3)
    assert math.isnan(magnitude_gain(MAGNITUDES, missing * np.nan, curves(0.0), 0.45).value)


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
    # Straight pieces between points 1 mag apart stand for a curve: a tenth of a magnitude.
    assert gains[0.3].value == pytest.approx(0.3, abs=0.1)
    assert gains[0.3].decided == 1


def test_differences_by_flux_are_paired() -> None:
    result = made_up_magnitude(0.3)
    for estimate, runs in zip(
        differences_by_flux(result, 1, 0), result.strehl[1] - result.strehl[0], strict=True
    ):
        assert estimate.value == pytest.approx(runs.mean())
        assert estimate.high - estimate.low < 0.02  # the air's 0.02 is common to both
