"""The numbers of a report equal plain NumPy on each sub-aperture's valid frames."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.refusals import refused

from faintspot.base.flags import SubapertureFlag
from faintspot.slopes.recorded import statistics
from faintspot.slopes.recorded.statistics import MeasuredSlopes


def make_method(
    n_frames: int, n: int, seed: int = 0, dark_fraction: float = 0.3, name: str = "TV"
) -> MeasuredSlopes:
    rng = np.random.default_rng(seed)
    x, y = rng.normal(size=(2, n_frames, n)).astype(np.float32)
    dark = rng.random((n_frames, n)) < dark_fraction
    flags = np.where(dark, int(SubapertureFlag.NO_FLUX), 0).astype(np.uint8)
    flux = rng.exponential(100.0, (n_frames, n)).astype(np.float32)
    return MeasuredSlopes(name, x, y, flux, flags)


def expected(values: np.ndarray, valid: np.ndarray, function: Any, least: int = 1) -> np.ndarray:
    """Apply a function to each column's valid values."""
    columns = [values[valid[:, i], i].astype(np.float64) for i in range(values.shape[1])]
    return np.array([function(column) if len(column) >= least else np.nan for column in columns])


@given(st.integers(1, 12), st.integers(1, 5), st.integers(0, 99), st.sampled_from([0.0, 0.4, 1.0]))
def test_column_statistics_equal_plain_numpy(n_frames: int, n: int, seed: int, dark: float) -> None:
    method = make_method(n_frames, n, seed, dark)
    valid = method.valid

    for function, reference, least in (
        (statistics.mean_over_valid, np.mean, 1),
        (statistics.median_over_valid, np.median, 1),
        (statistics.std_over_valid, lambda v: np.std(v, ddof=1), 2),
    ):
        # Only the order of float64 sums of float32 values differs.
        np.testing.assert_allclose(
            function(method.x, valid), expected(method.x, valid, reference, least), rtol=1e-9
        )


def test_blocks_do_not_change_the_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    method = make_method(20, 13)
    whole, scatter = statistics.summarise(method), statistics.jitter(method.x, method.y, method.valid)
    monkeypatch.setattr(statistics, "_BLOCK_NUMBERS", 60)
    assert len(list(statistics.column_blocks(20, 13))) == 5
    np.testing.assert_array_equal(statistics.summarise(method).flux_e, whole.flux_e)
    np.testing.assert_array_equal(statistics.jitter(method.x, method.y, method.valid).px, scatter.px)


def test_summary_is_of_valid_measurements_only() -> None:
    method = make_method(30, 6)
    summary = statistics.summarise(method)
    assert summary.valid_fraction == method.valid.mean()
    assert summary.median_flux_e == np.median(method.flux[method.valid])
    np.testing.assert_array_equal(summary.valid_frames, method.valid.sum(axis=0))
    for found, values, function in (
        (summary.flux_e, method.flux, np.median),
        (summary.x_px, method.x, np.mean),
        (summary.y_px, method.y, np.mean),
    ):
        np.testing.assert_allclose(found, expected(values, method.valid, function))
    scatter = statistics.jitter(method.x, 2 * method.y, method.valid)
    variances = [expected(axis, method.valid, lambda v: np.var(v, ddof=1)) for axis in (method.x, method.y)]
    np.testing.assert_allclose(scatter.x_px**2, variances[0])
    np.testing.assert_allclose(scatter.y_px**2, 4 * variances[1])
    np.testing.assert_allclose(scatter.px**2, (variances[0] + 4 * variances[1]) / 2)


def test_flags_are_counted_alone_and_together() -> None:
    flags = np.array([[32, 0, 33, 1]], np.uint8)  # NOT_CONVERGED; fine; both NO_FLUX and NOT_CONVERGED; dark
    zero = np.zeros((1, 4))
    method = MeasuredSlopes("TV", zero, zero, zero, flags)
    assert method.flag_count(SubapertureFlag.NO_FLUX) == 2
    assert method.flag_count(SubapertureFlag.NO_FLUX | SubapertureFlag.NOT_CONVERGED) == 1


def test_nothing_valid_gives_nan_without_warnings() -> None:
    method = make_method(5, 3, dark_fraction=1.0)
    summary = statistics.summarise(method)
    assert summary.valid_fraction == 0
    assert np.isnan(summary.median_flux_e)
    truth = np.zeros((5, 3, 2))
    assert np.isnan(statistics.slope_error(method, truth, method.valid)[0].value)
    assert not statistics.jitter(method.x, method.y, method.valid).measured.any()


def test_gain_is_that_of_a_shrinking_estimator() -> None:
    truth = np.random.default_rng(1).uniform(-1, 1, (50, 4, 2))
    zero = np.zeros((50, 4), np.uint8)
    method = MeasuredSlopes("half", 0.5 * truth[..., 0] + 0.3, 0.5 * truth[..., 1], zero + 1.0, zero)
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


@pytest.mark.parametrize(
    "change", [{"y": np.zeros((2, 4))}, {"x": np.zeros(3)}, {"flux": np.full((2, 3), np.nan)}]
)
def test_methods_that_do_not_fit_are_refused_in_one_line(change: dict[str, np.ndarray]) -> None:
    arrays = {name: np.zeros((2, 3)) for name in ("x", "y", "flux", "flags")} | change
    with refused("TV"):
        MeasuredSlopes("TV", **arrays)


def test_frames_written_twice_do_not_lower_the_noise() -> None:
    method = make_method(400, 5, dark_fraction=0.0)
    twice = np.repeat(np.arange(400), 2)
    columns = [getattr(method, name)[twice] for name in statistics.ARRAYS]
    repeated = MeasuredSlopes("TV", *columns)
    assert np.count_nonzero(repeated.repeated) == 400
    single, double = (statistics.frame_to_frame_noise(each, each.valid) for each in (method, repeated))
    np.testing.assert_allclose(double, single)
