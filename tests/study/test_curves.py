"""Curves of R against signal, and the flux gain with its confidence interval."""

from __future__ import annotations

import numpy as np
import pytest
from tests.study.study_cases import cells, dataset, power_law

from faintspot.errors import InputError
from faintspot.study.curves import Configuration, gain_at_error, gain_at_flux, study_curves
from faintspot.study.metric import flux_gain

CONFIGURATION = Configuration("diffraction", 1.0, 0.1, 1.0, 1.0, 16)


def gain_of(cell: object, arm: str, mode: str) -> float:
    return {"tv": 2.0, "gaussian": 0.001, "median": 10000.0}.get(arm, 1.0)


def curve(**options: object):  # type: ignore[no-untyped-def]
    study = dataset(cells(), power_law(gain_of), **options)  # type: ignore[arg-type]
    return study_curves(study, "best")[CONFIGURATION]


def test_curve_holds_the_cells_of_a_configuration_by_flux() -> None:
    study = dataset([*reversed(cells()), *cells(size=2.0)], power_law(gain_of))
    found = study_curves(study, "best")
    assert [configuration.size for configuration in found] == [1.0, 2.0]
    assert np.all(np.diff(found[CONFIGURATION].flux_e) > 0)
    r, se = found[CONFIGURATION].at(30.0, "plain") or (0.0, 0.0)
    assert r == power_law(gain_of)(cells()[1], "plain", "best")
    assert se == pytest.approx(0.003 * r)
    assert found[CONFIGURATION].at(31.0, "plain") is None


def test_unfinished_cells_are_left_out() -> None:
    assert len(curve(unfinished=(0, 4)).flux_e) == 3


@pytest.mark.parametrize("flux", [30.0, 80.0, 150.0])
def test_gain_agrees_with_the_metric(flux: float) -> None:
    item = curve()
    gain = gain_at_flux(item, flux, np.random.default_rng(1))
    assert gain is not None
    # The grid's step is 0.3 % of flux; linear interpolation within it is far better.
    assert gain.factor == pytest.approx(
        flux_gain(item.flux_e, item.of("plain"), item.of("tv"), flux), rel=1e-3
    )
    assert gain.low < gain.factor < gain.high
    assert gain.magnitudes[0] == pytest.approx(2.5 * np.log10(gain.factor))


def test_gain_at_an_error_is_that_at_the_flux_where_it_is_reached() -> None:
    item = curve()
    r, _ = item.at(80.0, "plain") or (0.0, 0.0)
    by_error = gain_at_error(item, r, np.random.default_rng(1))
    by_flux = gain_at_flux(item, 80.0, np.random.default_rng(1))
    assert by_error is not None
    assert by_flux is not None
    assert by_error.factor == pytest.approx(by_flux.factor, rel=1e-3)


def test_interval_covers_the_truth_as_often_as_it_says() -> None:
    """300 noisy studies: 95 % +- 3 standard deviations of the binomial count, 1.3 %."""
    rng = np.random.default_rng(3)
    exact = curve()
    pair = [exact.arms.index("plain"), exact.arms.index("tv")]
    truth = flux_gain(exact.flux_e, exact.of("plain"), exact.of("tv"), 80.0)
    hits = 0
    for _ in range(300):
        noisy = exact.error.copy()
        for i in range(len(noisy)):
            part = exact.covariance[i][np.ix_(pair, pair)]
            noisy[i, pair] = rng.multivariate_normal(exact.error[i, pair], part)
        item = type(exact)(
            exact.configuration, exact.flux_e, exact.arms, noisy, exact.error_se, exact.covariance
        )
        gain = gain_at_flux(item, 80.0, rng)
        assert gain is not None
        hits += gain.low <= truth <= gain.high
    assert 0.911 < hits / 300 < 0.989


def test_error_beyond_the_curve_of_the_method_is_said() -> None:
    item = curve()
    rng = np.random.default_rng(1)
    never = gain_at_flux(item, 80.0, rng, method="gaussian")
    always = gain_at_flux(item, 80.0, rng, method="median")
    assert never is not None
    assert always is not None
    assert never.factor == 0
    assert np.isinf(always.factor)
    assert never.is_bounded
    assert not always.is_bounded
    assert "less than any" in never.in_words()
    assert "more than any" in always.in_words()
    assert np.isinf(never.log_se)


def test_without_a_curve_there_is_no_gain() -> None:
    rng = np.random.default_rng(1)
    assert gain_at_flux(curve(unfinished=(1, 2, 3, 4)), 10.0, rng) is None
    assert gain_at_flux(curve(), 5.0, rng) is None
    assert gain_at_error(curve(), 100.0, rng) is None


def test_paired_difference_uses_the_covariance() -> None:
    item = curve(correlation=0.9)
    difference, se = item.difference("tv", "plain")
    plain, tv = item.se_of("plain"), item.se_of("tv")
    np.testing.assert_allclose(se, np.sqrt(plain**2 + tv**2 - 1.8 * plain * tv))
    np.testing.assert_allclose(difference, item.of("plain") - item.of("tv"))


def test_configuration_in_words() -> None:
    text = Configuration("gaussian", 4.0, 3.0, 1.5, 3.0, 12, 2.0, 500.0).in_words()
    for word in ("gaussian", "±4 px", "3 e-", "1.5", "elongated 3", "12 × 12", "background 2", "EM gain 500"):
        assert word in text


def test_bad_input_is_refused() -> None:
    rng = np.random.default_rng(1)
    with pytest.raises(InputError, match="mode 'worst'"):
        study_curves(dataset(cells(), power_law(gain_of)), "worst")
    with pytest.raises(InputError, match="arms 'plain' and 'magic'"):
        gain_at_flux(curve(), 80.0, rng, method="magic")
    with pytest.raises(InputError, match="flux_e"):
        gain_at_flux(curve(), 0.0, rng)
    with pytest.raises(InputError, match="arm 'magic'"):
        curve().of("magic")
