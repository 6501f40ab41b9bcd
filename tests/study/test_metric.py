"""The slope error R and the flux gain against what is known in closed form."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from faintspot.errors import InputError
from faintspot.study import metric
from faintspot.study.metric import (
    absolute_errors,
    flux_gain,
    flux_gain_with_error,
    magnitudes,
    slope_error,
    slope_statistics,
)

FLUX = np.array([10.0, 20.0, 40.0, 80.0, 160.0])


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


@pytest.mark.parametrize(
    ("x", "y", "truth", "words"),
    [
        (np.ones(3), np.ones(3), np.ones(3), "truth: expected shape (3, 2)"),
        (np.ones(3), np.ones(3), np.ones((2, 2)), "truth: expected shape (3, 2)"),
        (np.full(3, np.nan), np.ones(3), np.ones((3, 2)), "x: expected finite numbers"),
        (np.ones(3), np.ones(3), np.full((3, 2), np.inf), "truth: expected finite numbers"),
    ],
)
def test_bad_positions(x: Any, y: Any, truth: Any, words: str) -> None:
    with pytest.raises(InputError) as error:
        slope_error(x, y, truth)
    assert words in str(error.value)


def test_standard_error_of_r_covers_the_truth() -> None:
    """The mean of (|dx| + |dy|) / 2 of unit normal errors is sqrt(2 / pi).

    2000 experiments of 200 slopes: the fraction within one standard error is binomial with p = 0.683; 4.9
    standard deviations (0.051) allow a false alarm in 1e6, and skewness at 200 slopes moves p by < 0.01.
    """
    errors = np.random.default_rng(2).normal(size=(2000, 200, 2))
    estimates = [slope_error(e[:, 0], e[:, 1], np.zeros((200, 2))) for e in errors]
    deviations = np.array([(e.value - np.sqrt(2 / np.pi)) / e.standard_error for e in estimates])
    assert abs(np.mean(np.abs(deviations) < 1) - 0.683) < 0.061


@given(st.floats(1.0, 1.9), st.floats(0.3, 1.0), st.floats(25.0, 150.0))
def test_flux_gain_of_power_laws(ratio: float, power: float, at: float) -> None:
    """R = a * flux^-power is a straight line in log-log, reproduced to the 1e-9 that makes curves fall."""
    plain = 2.0 * FLUX**-power
    assert flux_gain(FLUX, plain, 2.0 * (ratio * FLUX) ** -power, at) == pytest.approx(ratio, rel=1e-7)


def test_flux_gain_below_one_where_the_method_is_worse() -> None:
    assert flux_gain(FLUX, 1 / FLUX, 1.25 / FLUX, 40.0) == pytest.approx(0.8, rel=1e-7)


@pytest.mark.parametrize("at", [10.0, 25.0, 55.0, 160.0])
@pytest.mark.parametrize("curve", [[0.5, 0.49, 0.3, 0.1, 0.09], [0.5, 0.3, 0.3, 0.31, 0.1]])
def test_flux_gain_of_equal_curves_is_one_whatever_their_shape(curve: list[float], at: float) -> None:
    assert flux_gain(FLUX, curve, curve, at) == pytest.approx(1.0, rel=1e-3)


def test_flux_gain_is_nan_where_the_method_does_not_reach_the_error() -> None:
    assert np.isnan(flux_gain(FLUX, 1 / FLUX, 10 / FLUX, 40.0))
    assert np.isnan(flux_gain(FLUX, 1 / FLUX, 0.1 / FLUX, 40.0))  # better than that at its faintest flux


def test_flux_gain_of_noisy_and_flat_curves_is_finite() -> None:
    assert np.isfinite(flux_gain(FLUX, [0.5, 0.52, 0.3, 0.31, 0.1], [0.5, 0.4, 0.4, 0.4, 0.1], 40.0))


@pytest.mark.parametrize(
    ("flux", "plain", "method", "at", "words"),
    [
        (FLUX[::-1], 1 / FLUX, 1 / FLUX, 40.0, "flux_e: expected at least two increasing"),
        ([10.0], [0.1], [0.1], 10.0, "flux_e: expected at least two increasing"),
        ([0.0, 1.0], [0.1, 0.1], [0.1, 0.1], 1.0, "flux_e = 0"),
        (FLUX, 1 / FLUX, 1 / FLUX, 5.0, "at_flux_e = 5: expected a number from 10 to 160"),
        (FLUX, 1 / FLUX, 1 / FLUX, np.nan, "at_flux_e"),
        (FLUX, 0 * FLUX, 1 / FLUX, 40.0, "errors_plain = 0"),
        (FLUX, 1 / FLUX, np.full(5, np.nan), 40.0, "errors_method: expected finite"),
        (FLUX, 1 / FLUX, [0.1, 0.2], 40.0, "errors_method: expected shape (5,), got (2,)"),
    ],
)
def test_bad_curves(flux: Any, plain: Any, method: Any, at: float, words: str) -> None:
    with pytest.raises(InputError) as error:
        flux_gain(flux, plain, method, at)
    assert words in str(error.value)
    assert "\n" not in str(error.value)


def test_standard_error_of_the_flux_gain_covers_the_truth(monkeypatch: pytest.MonkeyPatch) -> None:
    """60 experiments with a true gain of 1.5, half of the errors' variance shared by both methods.

    Within two standard errors: binomial with p = 0.95, fewer than 47 of 60 in 1e-6 of the runs; within half
    of one: p = 0.383, more than 42 of 60 in 1e-6. Too small and too large standard errors are both found.
    """
    monkeypatch.setattr(metric, "_RESAMPLES", 80)
    rng = np.random.default_rng(3)
    deviations = []
    for _ in range(60):
        shared, plain, method = np.abs(rng.normal(size=(3, 5, 150)))
        gain = flux_gain_with_error(
            FLUX, (shared + plain) / FLUX[:, None], (shared + method) / (1.5 * FLUX[:, None]), 40.0, rng
        )
        deviations.append(abs(gain.value - 1.5) / gain.standard_error)
    assert sum(deviation < 2 for deviation in deviations) >= 47
    assert sum(deviation < 0.5 for deviation in deviations) <= 42


def test_flux_gain_with_error_where_it_is_not_reached() -> None:
    errors = np.ones((5, 20)) / FLUX[:, None]
    gain = flux_gain_with_error(FLUX, errors, 100 * errors, 40.0, np.random.default_rng(4))
    assert np.isnan(gain.value)
    assert np.isnan(gain.standard_error)
    with pytest.raises(InputError, match="one shape"):
        flux_gain_with_error(FLUX, errors, errors[:, :3], 40.0)


def test_flux_gain_with_error_is_reproducible_and_leaves_its_input_alone() -> None:
    plain, method = errors = np.abs(np.random.default_rng(5).normal(size=(2, 5, 50))) / FLUX[:, None]
    before = errors.copy()
    one, two = (flux_gain_with_error(FLUX, plain, method, 40.0, np.random.default_rng(6)) for _ in range(2))
    assert one == two
    np.testing.assert_array_equal(errors, before)


def test_magnitudes() -> None:
    assert magnitudes(100.0) == pytest.approx(5.0)
    assert magnitudes(1.0) == 0.0


def gained(n: int, seed: int, gain: float = 0.6, noise: float = 0.2) -> tuple[Any, Any]:
    rng = np.random.default_rng(seed)
    truth = rng.uniform(-1, 1, (n, 2))
    return gain * truth + (0.1, -0.2) + rng.normal(0, noise, (n, 2)), truth


def test_statistics_of_a_known_estimator() -> None:
    """gain 0.6, offsets 0.1 and -0.2, noise 0.2 px: 5 standard errors, 6e-7 for each of them."""
    found, truth = gained(20_000, 1)
    statistics = slope_statistics(found[:, 0], found[:, 1], truth)
    expected = {
        "gain": 0.6,
        "rms": np.sqrt(0.16 / 3 + 0.04 + 0.025),
        "corrected_rms": 0.2 / 0.6,
    }
    for name, value in expected.items():
        estimate = getattr(statistics, name)
        assert abs(estimate.value - value) < 5 * estimate.standard_error, name
        assert estimate.standard_error < 0.01
    assert statistics.error == slope_error(found[:, 0], found[:, 1], truth)
    assert statistics.invalid_fraction.value == 0.0


def test_standard_errors_of_statistics_are_the_spread() -> None:
    """Over 300 experiments: the spread is known to 4 %; 5 of those are 20 %."""
    samples = [gained(400, seed) for seed in range(300)]
    every = [slope_statistics(found[:, 0], found[:, 1], truth) for found, truth in samples]
    for name in ("error", "gain", "rms", "corrected_rms"):
        spread = np.std([getattr(s, name).value for s in every])
        stated = np.mean([getattr(s, name).standard_error for s in every])
        assert stated == pytest.approx(spread, rel=0.2), name


def test_falling_back_to_the_centre_is_seen() -> None:
    """R alone prefers no estimate at all to a noisy one; gain, validity and corrected rms do not."""
    rng = np.random.default_rng(3)
    truth = rng.uniform(-1, 1, (1000, 2))
    nothing = slope_statistics(np.zeros(1000), np.zeros(1000), truth, valid=np.zeros(1000, bool))
    noisy_slopes = truth + rng.normal(0, 0.7, truth.shape)
    noisy = slope_statistics(noisy_slopes[:, 0], noisy_slopes[:, 1], truth)
    assert nothing.error.value < noisy.error.value
    assert nothing.gain.value == 0.0
    assert nothing.corrected_rms.value == np.inf
    assert nothing.invalid_fraction.value == 1.0
    assert nothing.outlier_fraction.value == 0.0


def test_outliers_are_beyond_the_limit_on_either_axis() -> None:
    x, y = np.array([0.0, 1.5, 0.0, 0.9]), np.array([0.0, 0.0, -2.0, 0.9])
    truth = np.zeros((4, 2))
    assert slope_statistics(x, y, truth).outlier_fraction.value == 0.5
    assert slope_statistics(x, y, truth, outlier_px=0.5).outlier_fraction.value == 0.75
    assert np.isnan(slope_statistics(x, y, truth).gain.value)  # the truth does not vary


def test_perfect_slopes() -> None:
    truth = np.random.default_rng(4).uniform(-1, 1, (2, 5, 2))
    statistics = slope_statistics(truth[..., 0], truth[..., 1], truth)
    assert statistics.gain.value == pytest.approx(1.0)
    assert statistics.corrected_rms.value == pytest.approx(0.0, abs=1e-12)
    assert statistics.rms.value == 0.0


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"valid": [True]}, "valid: expected shape (3,)"),
        ({"outlier_px": 0}, "outlier_px = 0"),
    ],
)
def test_bad_statistics(options: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError) as error:
        slope_statistics(np.ones(3), np.ones(3), np.ones((3, 2)), **options)
    assert words in str(error.value)
    with pytest.raises(InputError, match="at least one value"):
        slope_statistics([], [], np.ones((0, 2)))
