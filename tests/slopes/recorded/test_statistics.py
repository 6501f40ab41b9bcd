"""The numbers of a report equal plain NumPy on each sub-aperture's valid frames."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.refusals import refused
from tests.slopes.recorded.recorded_cases import method_of

from faintspot.base.flags import SubapertureFlag
from faintspot.slopes.recorded import statistics
from faintspot.slopes.recorded.statistics import MeasuredSlopes


def make_method(n_frames: int, n: int, seed: int = 0, dark_fraction: float = 0.3) -> MeasuredSlopes:
    rng = np.random.default_rng(seed)
    x, y = rng.normal(size=(2, n_frames, n)).astype(np.float32)
    dark = rng.random((n_frames, n)) < dark_fraction
    flags = np.where(dark, int(SubapertureFlag.NO_FLUX), 0)
    return method_of("TV", x, y, rng.exponential(100.0, (n_frames, n)), flags)


def expected(values: np.ndarray, valid: np.ndarray, function: Any, least: int = 1) -> np.ndarray:
    """Apply a function to each column's valid values."""
    columns = [values[valid[:, i], i].astype(np.float64) for i in range(values.shape[1])]
    return np.array([function(column) if len(column) >= least else np.nan for column in columns])


@given(st.integers(1, 12), st.integers(1, 5), st.integers(0, 99), st.sampled_from([0.0, 0.4, 1.0]))
def test_column_statistics_equal_plain_numpy(n_frames: int, n: int, seed: int, dark: float) -> None:
    """Only the order of float64 sums of float32 values differs."""
    method = make_method(n_frames, n, seed, dark)
    slopes, valid = method.slopes, method.valid
    np.testing.assert_allclose(method.flux_e, expected(slopes.flux, valid, np.median), rtol=1e-9)
    for found, values in zip(method.mean_px.T, (slopes.x, slopes.y), strict=True):
        np.testing.assert_allclose(found, expected(values, valid, np.mean), rtol=1e-9)
    variances = [expected(axis, valid, lambda v: np.var(v, ddof=1), 2) for axis in (slopes.x, slopes.y)]
    np.testing.assert_allclose(statistics.jitter(method, valid) ** 2, sum(variances) / 2, rtol=1e-9)


def test_blocks_do_not_change_the_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    method = make_method(20, 13)
    flux, scatter = method.flux_e, statistics.jitter(method, method.valid)
    monkeypatch.setattr(statistics, "_BLOCK_NUMBERS", 60)
    np.testing.assert_array_equal(make_method(20, 13).flux_e, flux)
    np.testing.assert_array_equal(statistics.jitter(method, method.valid), scatter)


def test_gain_is_that_of_a_shrinking_estimator() -> None:
    truth = np.random.default_rng(1).uniform(-1, 1, (50, 4, 2))
    method = method_of("half", 0.5 * truth[..., 0] + 0.3, 0.5 * truth[..., 1])
    assert statistics.slope_error(method, truth, method.valid)[1] == pytest.approx(0.5)
    still = np.zeros_like(truth)
    assert np.isnan(statistics.slope_error(method, still, method.valid)[1])


def test_standard_error_of_independent_measurements() -> None:
    values = np.random.default_rng(2).normal(size=(400, 100))
    # 100 groups know their scatter to 7 %; the larger of two estimates: 0.8 to 1.35 of the truth.
    assert 0.8 < statistics.standard_error(values, np.ones_like(values, bool)) * 200 < 1.35


def test_standard_error_sees_a_bias_of_each_subaperture() -> None:
    rng = np.random.default_rng(3)
    values = rng.normal(size=(1, 50)) + 0.01 * rng.normal(size=(1000, 50))
    expected_error = np.std(values.mean(axis=0), ddof=1) / np.sqrt(50)
    assert statistics.standard_error(values, np.ones_like(values, bool)) == pytest.approx(expected_error)
    assert np.isnan(statistics.standard_error(values[:1, :1], np.ones((1, 1), bool)))


def test_slopes_that_are_not_finite_are_refused() -> None:
    with refused("TV"):
        method_of("TV", np.full((2, 3), np.nan), np.zeros((2, 3)))


def test_frames_written_twice_do_not_lower_the_noise() -> None:
    method = make_method(400, 5, dark_fraction=0.0)
    twice = np.repeat(np.arange(400), 2)
    repeated = method_of("TV", method.slopes.x[twice], method.slopes.y[twice])
    single, double = (statistics.frame_to_frame_noise(each, each.valid) for each in (method, repeated))
    np.testing.assert_allclose(double, single)
