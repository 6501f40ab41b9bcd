"""Curves of R against the flux, and what follows from them, with intervals."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import PchipInterpolator
from scipy.optimize import brentq
from tests.refusals import refused

from faintspot.experiments.curves import (
    Curve,
    Gain,
    gain_at_error,
    gain_at_flux,
    limiting_flux,
    magnitude_gain,
)

FLUX = np.array([10.0, 20.0, 40.0, 80.0, 160.0])


def exact(reference: ArrayLike, method: ArrayLike, flux: NDArray[np.float64] = FLUX) -> Curve:
    """Curves without noise."""
    error = np.column_stack([reference, method]).astype(float)
    return Curve(flux, ("reference", "method"), error, np.zeros((len(flux), 2, 2)))


def gain(curve: Curve, at: float, seed: int = 1) -> Gain:
    found = gain_at_flux(curve, at, np.random.default_rng(seed), method="method", reference="reference")
    assert found is not None
    return found


def with_scatter(method_flux: float, n: int = 2000) -> Curve:
    """R = sqrt(10 / flux), and of a method that needs less flux, with 10 % of scatter that both share."""
    flux = np.geomspace(10, 1000, 7)
    scatter = 1 + 0.1 * np.random.default_rng(1).standard_normal((len(flux), n))
    scatter /= scatter.mean(axis=1, keepdims=True)
    of = {
        name: np.sqrt(needed / flux)[:, None] * scatter
        for name, needed in (("reference", 10.0), ("method", method_flux))
    }
    return Curve.of_errors(flux, of)


@given(st.floats(0.8, 1.9), st.floats(0.3, 1.0), st.floats(25.0, 125.0))
def test_gain_of_power_laws(ratio: float, power: float, at: float) -> None:
    """R = a * flux^-power is a straight line in log-log, reproduced to the 1e-9 that makes curves fall."""
    curve = exact(2.0 * FLUX**-power, 2.0 * (ratio * FLUX) ** -power)
    assert gain(curve, at).factor == pytest.approx(ratio, rel=1e-7)


def test_gain_is_where_the_interpolated_curves_say() -> None:
    """The grid's step is 0.3 % of flux; linear interpolation within it is far better. Equal curves: 1."""
    for values in ([0.5, 0.49, 0.3, 0.1, 0.09], [0.5, 0.3, 0.3, 0.31, 0.1]):
        gains = [gain(exact(values, values), at).factor for at in (10.0, 25.0, 55.0, 160.0)]
        assert gains == pytest.approx([1.0] * 4, rel=1e-3)
    reference, method = np.array([0.5, 0.35, 0.2, 0.1, 0.06]), np.array([0.4, 0.25, 0.13, 0.08, 0.05])
    curve = PchipInterpolator(np.log(FLUX), np.log(method))
    for at in (25.0, 60.0, 130.0):
        wanted = PchipInterpolator(np.log(FLUX), np.log(reference))(np.log(at))
        needed = math.exp(brentq(lambda place, wanted=wanted: curve(place) - wanted, *np.log(FLUX[[0, -1]])))
        assert gain(exact(reference, method), at).factor == pytest.approx(at / needed, rel=1e-3)


def test_an_error_beyond_the_curve_of_the_method_is_said() -> None:
    never, always = gain(exact(1 / FLUX, 100 / FLUX), 40.0), gain(exact(1 / FLUX, 0.01 / FLUX), 40.0)
    assert never.factor == 0
    assert np.isinf(always.factor)
    assert never.is_bounded
    assert not always.is_bounded
    assert "less than any" in never.in_words()
    assert "more than any" in always.in_words()
    assert np.isinf(never.log_se)


def test_standard_error_of_the_gain_covers_the_truth() -> None:
    """60 experiments with a true gain of 1.5, half of the errors' variance shared by both methods.

    Within two standard errors: binomial with p = 0.95, fewer than 47 of 60 in 1e-6 of the runs; within half
    of one: p = 0.383, more than 42 of 60 in 1e-6. Too small and too large standard errors are both found.
    """
    rng = np.random.default_rng(3)
    deviations = []
    for seed in range(60):
        shared, plain, method = np.abs(rng.normal(size=(3, 5, 150)))
        errors = {
            "reference": (shared + plain) / FLUX[:, None],
            "method": (shared + method) / (1.5 * FLUX[:, None]),
        }
        found = gain(Curve.of_errors(FLUX, errors), 40.0, seed)
        deviations.append(abs(math.log(found.factor / 1.5)) / found.log_se)
    assert sum(deviation < 2 for deviation in deviations) >= 47
    assert sum(deviation < 0.5 for deviation in deviations) <= 42


def test_half_the_flux_is_three_quarters_of_a_magnitude() -> None:
    curve = with_scatter(5.0)
    found = magnitude_gain(curve, 100.0, np.random.default_rng(3), method="method", reference="reference")
    assert found.value == pytest.approx(2.5 * math.log10(2), abs=0.01)
    # 10 % of scatter over 2000 spots is 0.22 % of R or 0.45 % of the flux, at both ends of the step.
    assert found.standard_error == pytest.approx(2.5 * math.log10(math.e) * 0.0045 * math.sqrt(2), rel=0.2)
    near = with_scatter(9.9)
    found = magnitude_gain(near, 100.0, np.random.default_rng(3), method="method", reference="reference")
    assert found.standard_error < 0.001  # the spots are the same, so nearly nothing is left of the scatter
    itself = magnitude_gain(curve, 100.0, np.random.default_rng(3), method="method", reference="method")
    assert itself.value == 0.0


def test_gain_beyond_the_curve_has_a_sign() -> None:
    options: Any = {"method": "method", "reference": "reference"}
    for flux, expected in ((0.01, math.inf), (1e4, -math.inf)):
        curve, rng = with_scatter(flux), np.random.default_rng(3)
        assert magnitude_gain(curve, 100.0, rng, **options).value == expected
        assert math.isnan(magnitude_gain(curve, 5.0, rng, **options).value)


def test_limiting_flux_has_its_error() -> None:
    limit = limiting_flux(with_scatter(5.0), "reference", 0.5, np.random.default_rng(3))
    assert limit.value == pytest.approx(40.0, rel=0.01)
    # 10 % of scatter over 2000 spots is 0.22 % of R, 0.45 % of the flux, less between two points.
    assert 0.05 < limit.standard_error < 0.25
    for budget, expected in ((0.01, math.inf), (2.0, 0.0)):
        assert (
            limiting_flux(with_scatter(5.0), "reference", budget, np.random.default_rng(3)).value == expected
        )


def test_covariance_is_that_of_the_means() -> None:
    errors = np.abs(np.random.default_rng(4).normal(size=(2, 5, 50)))
    curve = Curve.of_errors(FLUX, {"a": errors[0], "b": errors[1]})
    np.testing.assert_allclose(curve.of("b"), errors[1].mean(axis=1))
    np.testing.assert_allclose(curve.covariance[2], np.cov(errors[:, 2], ddof=0) / 50)
    difference, se = curve.difference("a", "b")
    np.testing.assert_allclose(difference, (errors[1] - errors[0]).mean(axis=1))
    np.testing.assert_allclose(se, (errors[1] - errors[0]).std(axis=1) / math.sqrt(50))


def test_bad_input_is_refused() -> None:
    for flux, errors, word in (
        (FLUX[::-1], np.ones((5, 3)), "increasing"),
        ([10.0], np.ones((1, 3)), "increasing"),
        ([0.0, 1.0], np.ones((2, 3)), "flux_e = 0"),
        (FLUX, np.ones((4, 3)), "(5, n)"),
        (FLUX, np.ones(5), "(5, n)"),
    ):
        with refused(word):
            Curve.of_errors(flux, {"a": errors})
    curve, rng = exact(1 / FLUX, 1 / FLUX), np.random.default_rng(1)
    for function, at, method, word in (
        (gain_at_flux, 80.0, "magic", "'magic'"),
        (gain_at_flux, 0.0, "method", "flux_e"),
        (gain_at_error, 0.0, "method", "error_px"),
    ):
        with refused(word):
            function(curve, at, rng, method=method, reference="reference")
    with refused("'magic'"):
        curve.of("magic")
