"""Curves of R against signal, and the flux gain with its confidence interval."""

import numpy as np
import pytest
from tests.experiments.study_cases import cells, dataset, power_law
from tests.refusals import refused

from faintspot.experiments.curves import Curve, gain_at_error, gain_at_flux
from faintspot.experiments.methods import TV_OVER_NO_TV
from faintspot.experiments.study.curves import StudyConditions, study_curves

CONFIGURATION = StudyConditions("diffraction", 1.0, 0.1, 1.0, 1.0, 16)


def gain_of(cell: object, method: str, mode: str) -> float:
    return 2.0 if method == "tv" else 1.0


def curve(**options: object):  # type: ignore[no-untyped-def]
    study = dataset(cells(), power_law(gain_of), **options)  # type: ignore[arg-type]
    return study_curves(study, "best")[CONFIGURATION]


def test_curve_holds_the_cells_of_a_configuration_by_flux() -> None:
    study = dataset([*reversed(cells()), *cells(size=2.0)], power_law(gain_of))
    found = study_curves(study, "best")
    assert [configuration.size for configuration in found] == [1.0, 2.0]
    assert np.all(np.diff(found[CONFIGURATION].flux_e) > 0)
    r = found[CONFIGURATION].at(30.0, "brightest")
    assert r is not None
    assert r.value == power_law(gain_of)(cells()[1], "brightest", "best")
    assert r.standard_error == pytest.approx(0.003 * r.value)
    assert found[CONFIGURATION].at(31.0, "brightest") is None


def test_gain_at_an_error_is_that_at_the_flux_where_it_is_reached() -> None:
    item = curve()
    r = item.at(80.0, "brightest")
    assert r is not None
    by_error = gain_at_error(item, r.value, np.random.default_rng(1), **TV_OVER_NO_TV)
    by_flux = gain_at_flux(item, 80.0, np.random.default_rng(1), **TV_OVER_NO_TV)
    assert by_error is not None
    assert by_flux is not None
    assert by_error.factor == pytest.approx(by_flux.factor, rel=1e-3)


@pytest.mark.slow
def test_interval_covers_the_truth_as_often_as_it_says() -> None:
    """300 noisy studies: 95 % +- 3 standard deviations of the binomial count, 1.3 %."""
    rng = np.random.default_rng(3)
    exact = curve()
    pair = [exact.methods.index("brightest"), exact.methods.index("tv")]
    # Twice the flux, where log R is a straight line: as the interpolated curve says.
    known = gain_at_flux(exact, 80.0, rng, **TV_OVER_NO_TV)
    assert known is not None
    hits = 0
    for _ in range(300):
        noisy = exact.error.copy()
        for i in range(len(noisy)):
            part = exact.covariance[i][np.ix_(pair, pair)]
            noisy[i, pair] = rng.multivariate_normal(exact.error[i, pair], part)
        item = Curve(exact.flux_e, exact.methods, noisy, exact.covariance)
        gain = gain_at_flux(item, 80.0, rng, **TV_OVER_NO_TV)
        assert gain is not None
        hits += gain.low <= known.factor <= gain.high
    assert 0.911 < hits / 300 < 0.989


def test_without_a_curve_there_is_no_gain() -> None:
    rng = np.random.default_rng(1)
    assert len(curve(unfinished=(0, 4)).flux_e) == 3  # the other cells
    assert gain_at_flux(curve(unfinished=(1, 2, 3, 4)), 10.0, rng, **TV_OVER_NO_TV) is None
    assert gain_at_flux(curve(), 5.0, rng, **TV_OVER_NO_TV) is None
    assert gain_at_error(curve(), 100.0, rng, **TV_OVER_NO_TV) is None
    with refused("mode 'worst'"):
        study_curves(dataset(cells(), power_law(gain_of)), "worst")
