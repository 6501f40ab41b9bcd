import numpy as np
import pytest
from numpy.typing import NDArray
from tests.refusals import refused

from faintspot.loop.control.reconstructor import (
    add_noise,
    check_controllable,
    make_reconstructor,
    weighted_slopes,
)

N, COMMANDS = 20, 12
RNG = np.random.default_rng(1)
MATRIX = RNG.standard_normal((2 * N, COMMANDS))
COMMAND, SLOPES = RNG.standard_normal(COMMANDS), RNG.standard_normal(2 * N)
ERRORS = RNG.uniform(0.5, 2.0, 2 * N)
COVARIANCE = RNG.uniform(-0.9, 0.9, N) * ERRORS[:N] * ERRORS[N:]


def whole(covariance: NDArray[np.float64] | None) -> NDArray[np.float64]:
    matrix = np.diag(ERRORS**2)
    if covariance is not None:
        matrix += np.kron([[0.0, 1.0], [1.0, 0.0]], np.diag(covariance))
    return matrix


@pytest.mark.parametrize("covariance", [None, COVARIANCE])
def test_noise_with_covariances_weighs_as_its_whole_matrix(covariance: NDArray[np.float64] | None) -> None:
    """Weighted least squares have the smallest error; the ridge of 3 % is that of equal weights."""
    found = np.ones((2 * N, 2 * N))
    add_noise(found, ERRORS**2, covariance)
    np.testing.assert_allclose(found - 1, whole(covariance), atol=1e-15)
    weighted = np.linalg.solve(whole(covariance), MATRIX)
    np.testing.assert_allclose(weighted_slopes(MATRIX, ERRORS**2, covariance), weighted, rtol=1e-9)
    normal = weighted.T @ MATRIX
    normal += 0.03 * np.trace(normal) / COMMANDS * np.eye(COMMANDS)
    command = make_reconstructor(MATRIX, 1e6).weighted(SLOPES, ERRORS, covariance)
    np.testing.assert_allclose(command, np.linalg.solve(normal, weighted.T @ SLOPES), rtol=1e-9)


def test_slopes_whose_error_is_not_known_have_no_weight() -> None:
    variance = ERRORS**2
    variance[[0, N + 1]] = np.inf, np.nan
    weighted = weighted_slopes(MATRIX, variance, np.where(np.arange(N) < 2, 0.0, COVARIANCE))
    assert np.all(weighted[[0, N + 1]] == 0)
    np.testing.assert_allclose(weighted[N], MATRIX[N] / variance[N])
    narrow = weighted_slopes(MATRIX, ERRORS**2, ERRORS[:N] * ERRORS[N:])  # singular
    assert np.all(np.isfinite(narrow))
    reconstructor, errors = make_reconstructor(MATRIX), ERRORS.copy()
    errors[[0, 4, 8]] = np.inf, 0.0, np.nan
    wrong = np.where(errors > 0, SLOPES, 1e6)
    wrong[0] = -1e6
    command = reconstructor.weighted(SLOPES, errors)
    np.testing.assert_allclose(reconstructor.weighted(wrong, errors), command, atol=1e-9)
    for none in (np.inf, np.nan, 0.0):
        assert not reconstructor.weighted(SLOPES, np.full(2 * N, none)).any()
    np.testing.assert_allclose(reconstructor.weighted(SLOPES, np.full(2 * N, 0.3)), reconstructor(SLOPES))


def test_commands_come_back_but_for_the_ridge() -> None:
    reconstructor = make_reconstructor(MATRIX, 1e6)
    estimate = reconstructor(MATRIX @ COMMAND)
    assert np.corrcoef(estimate, COMMAND)[0, 1] > 0.99
    assert 0.85 < estimate @ COMMAND / (COMMAND @ COMMAND) < 1  # damped, never amplified
    left = np.linalg.norm(reconstructor.clean @ MATRIX @ COMMAND - COMMAND)
    assert left < 0.3 * np.linalg.norm(estimate - COMMAND)


def test_combinations_without_slopes_are_not_driven() -> None:
    matrix = MATRIX.copy()
    matrix[:, 1] = matrix[:, 0]  # two actuators that do the same
    reconstructor = make_reconstructor(matrix, 30.0)
    assert reconstructor.modes.shape == (12, 11)
    command = reconstructor(SLOPES)
    assert command[0] == pytest.approx(command[1])
    for weak, driven in ((0.04, 3), (0.03, 2)):
        assert make_reconstructor(np.diag([1.0, weak, 0.5]), 30.0).modes.shape == (3, driven)


def test_of_many_actuators_low_orders_are_corrected_as_well() -> None:
    """They move slopes a tenth as much as others; of few actuators, these would be among the noisiest."""
    corrected = [make_reconstructor(np.diag(np.linspace(0.1, 1.0, n)))(np.eye(n)[0])[0] for n in (100, 1000)]
    few, many = 0.1 * np.array(corrected)
    assert few < 0.5
    assert many > 1.3 * few


def test_what_is_refused() -> None:
    with refused("41 commands", "40 slopes"):
        check_controllable(41, 40)
    for matrix, word in (
        (MATRIX[:10], "12 commands"),
        (np.zeros((4, 2)), "interaction"),
        (np.ones(4), "interaction"),
        (np.full((4, 2), np.nan), "interaction"),
    ):
        with refused(word):
            make_reconstructor(matrix)
