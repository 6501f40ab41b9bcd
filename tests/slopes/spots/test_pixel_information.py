import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.stats import norm, poisson

from faintspot.slopes.spots.bounds import poisson_gaussian_information


@pytest.mark.parametrize(("read_noise", "mean"), [(0.3, 0.2), (0.7, 0.5), (1.0, 0.05), (2.0, 3.0)])
def test_information_of_a_pixel_by_brute_force(read_noise: float, mean: float) -> None:
    electrons = np.arange(60)

    def density(value: float, offset: float = 0.0) -> float:
        terms = poisson.pmf(electrons, mean + offset) * norm.pdf(value - electrons, scale=read_noise)
        return float(terms.sum())

    def integrand(value: float) -> float:
        step = 1e-4
        change = (density(value, step) - density(value, -step)) / (2 * step)
        return change**2 / density(value)

    expected = quad(integrand, -6 * read_noise, mean + 12, limit=300)[0]
    found = poisson_gaussian_information(np.array([mean]), read_noise)[0]
    assert found == pytest.approx(expected, rel=2e-3)


def test_information_of_a_pixel_in_its_limits() -> None:
    # Without flux it is exp(1 / read_noise^2) - 1, that of a shift by one electron.
    for read_noise in (0.6, 1.0, 3.0):
        found = poisson_gaussian_information(np.array([0.0]), read_noise)[0]
        assert found == pytest.approx(math.expm1(1 / read_noise**2), rel=1e-3)
    # Counting: 1 / mean. At 0.1 e- neighbouring numbers of electrons overlap by 3e-7.
    mean = np.array([1e-3, 0.1, 1.0, 10.0, 39.0, 41.0])
    for read_noise in (0.0, 0.02, 0.1):
        np.testing.assert_allclose(poisson_gaussian_information(mean, read_noise) * mean, 1, rtol=5e-4)
    # Much light: the variance alone counts.
    mean = np.array([200.0, 1e4])
    np.testing.assert_allclose(poisson_gaussian_information(mean, 2.0) * (mean + 4), 1, rtol=1e-4)


@given(st.floats(0, 100), st.sampled_from([0.1, 0.25, 0.5, 1.0, 3.0, 6.0, 9.0]))
def test_information_lies_between_gaussian_and_counting(mean: float, read_noise: float) -> None:
    found = poisson_gaussian_information(np.array([mean]), read_noise)[0]
    assert found >= (1 - 5e-4) / (max(mean, 1e-6) + read_noise**2)
    assert found <= (1 + 5e-4) / max(mean, 1e-6)
