import numpy as np
import pytest
from tests.experiments.night_cases import DRIFT_S, drifting

from faintspot.experiments.night.alternation import (
    Drift,
    coefficient,
    coefficients,
    jackknife,
    likeliest_drift,
    predicted_by_others,
)

TIME_S = np.linspace(0.0, 2.4 * 149, 150, dtype=np.float64)
ONE = np.ones((150, 1))


def test_the_fit_is_that_of_whitened_values() -> None:
    """Without drift, ordinary least squares."""
    rng = np.random.default_rng(2)
    design, values = rng.standard_normal((150, 3)), rng.standard_normal(150)
    for correlation in (np.eye(150), Drift(0.8, 30.0).correlation(TIME_S)):
        white = np.linalg.inv(np.linalg.cholesky(correlation))
        expected = np.linalg.lstsq(white @ design, white @ values, rcond=None)[0]
        np.testing.assert_allclose(coefficients(design, values, correlation), expected)


def test_drift_and_noise_are_told_apart() -> None:
    rng = np.random.default_rng(3)
    drift, noise = drifting(rng, TIME_S), rng.standard_normal(150)
    assert likeliest_drift(ONE, noise, TIME_S).share <= 0.1
    found = likeliest_drift(ONE, drift + 0.2 * noise, TIME_S)
    assert found.share >= 0.9
    assert DRIFT_S / 4 < found.time_s < DRIFT_S * 4


def test_values_are_predicted_from_all_other_groups() -> None:
    rng = np.random.default_rng(4)
    values = drifting(rng, TIME_S) + 0.2 * rng.standard_normal(150)
    group = np.arange(150) % 3
    found = predicted_by_others(values, TIME_S, group)
    assert np.std(found - values) < 0.5  # of the values: 1
    correlation = likeliest_drift(ONE, values, TIME_S).correlation(TIME_S)
    mean = coefficients(ONE, values, correlation)[0]
    own, others = group == 1, group != 1
    among = np.linalg.solve(correlation[np.ix_(others, others)], values[others] - mean)
    np.testing.assert_allclose(found[own], mean + correlation[np.ix_(own, others)] @ among)


def test_jackknife_of_a_mean_is_its_standard_error() -> None:
    """Fewer than three pieces have none."""
    values = np.random.default_rng(5).standard_normal(40)
    without = [float(np.delete(values, number).mean()) for number in range(40)]
    found = jackknife(float(values.mean()), without)
    assert found.standard_error == pytest.approx(values.std(ddof=1) / np.sqrt(40))
    assert found.high - found.value == pytest.approx(2.0227 * found.standard_error, rel=1e-4)  # t, 39
    assert np.isnan(jackknife(1.0, [1.0, 2.0]).standard_error)
    assert np.isnan(coefficient(ONE, TIME_S, TIME_S, np.repeat([0, 1], 75), 0).standard_error)
