"""Noise with covariances of x and y, against whole matrices."""

import numpy as np
import pytest
from numpy.typing import NDArray

from faintspot.loop.control.reconstructor import add_noise, make_reconstructor, weighted_slopes

RNG = np.random.default_rng(1)
N = 10
ERRORS = RNG.uniform(0.5, 2.0, 2 * N)
COVARIANCE = RNG.uniform(-0.9, 0.9, N) * ERRORS[:N] * ERRORS[N:]
INTERACTION = RNG.normal(size=(2 * N, 6))


def whole(covariance: NDArray[np.float64] | None) -> NDArray[np.float64]:
    matrix = np.diag(ERRORS**2)
    if covariance is not None:
        matrix += np.block([[np.zeros((N, N)), np.diag(covariance)], [np.diag(covariance), np.zeros((N, N))]])
    return matrix


@pytest.mark.parametrize("covariance", [None, COVARIANCE])
def test_matrix_and_its_inverse(covariance: NDArray[np.float64] | None) -> None:
    found = np.ones((2 * N, 2 * N))
    add_noise(found, ERRORS**2, covariance)
    np.testing.assert_allclose(found - 1, whole(covariance), atol=1e-15)
    weighted = weighted_slopes(INTERACTION, ERRORS**2, covariance)
    np.testing.assert_allclose(weighted, np.linalg.solve(whole(covariance), INTERACTION), rtol=1e-9)


def test_what_is_not_known_has_no_weight() -> None:
    variance = ERRORS**2
    variance[[0, N + 1]] = np.inf, np.nan
    weighted = weighted_slopes(INTERACTION, variance, np.where(np.arange(N) < 2, 0.0, COVARIANCE))
    assert np.all(weighted[[0, N + 1]] == 0)
    np.testing.assert_allclose(weighted[N], INTERACTION[N] / variance[N])
    narrow = weighted_slopes(INTERACTION, ERRORS**2, ERRORS[:N] * ERRORS[N:])  # singular
    assert np.all(np.isfinite(narrow))


def test_covariances_lower_the_error() -> None:
    """Of weighted least squares."""
    reconstructor = make_reconstructor(INTERACTION, 1e6)
    root = np.linalg.cholesky(whole(COVARIANCE))
    squares = np.zeros(2)
    for _ in range(200):
        command = RNG.normal(size=6)
        slopes = INTERACTION @ command + root @ RNG.normal(size=2 * N)
        for column, covariance in enumerate((None, COVARIANCE)):
            found = reconstructor.weighted(slopes, ERRORS, covariance)
            squares[column] += np.sum((found - command) ** 2)
    assert squares[1] < 0.9 * squares[0]
