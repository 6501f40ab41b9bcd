import numpy as np
import pytest
from tests.refusals import refused

from faintspot.loop.control.reconstructor import check_controllable, make_reconstructor


def _matrix(slopes: int = 40, commands: int = 12) -> np.ndarray:
    return np.random.default_rng(1).standard_normal((slopes, commands))


def test_the_reconstructor_gives_back_commands_but_for_its_ridge() -> None:
    matrix = _matrix()
    command = np.random.default_rng(2).standard_normal(12)
    estimate = make_reconstructor(matrix, 1e6)(matrix @ command)
    assert np.corrcoef(estimate, command)[0, 1] > 0.99
    assert 0.85 < estimate @ command / (command @ command) < 1  # damped, never amplified


def test_combinations_without_slopes_are_not_driven() -> None:
    matrix = _matrix()
    matrix[:, 1] = matrix[:, 0]  # two actuators that do the same
    reconstructor = make_reconstructor(matrix, 30.0)
    assert reconstructor.modes.shape == (12, 11)
    command = reconstructor(np.random.default_rng(3).standard_normal(40))
    assert command[0] == pytest.approx(command[1])


def test_equal_errors_weigh_as_none() -> None:
    reconstructor, slopes = make_reconstructor(_matrix()), np.random.default_rng(4).standard_normal(40)
    np.testing.assert_allclose(reconstructor.weighted(slopes, np.full(40, 0.3)), reconstructor(slopes))


def test_slopes_without_a_standard_error_do_not_count() -> None:
    reconstructor, slopes = make_reconstructor(_matrix()), np.random.default_rng(5).standard_normal(40)
    errors = np.where(np.arange(40) % 4 == 0, np.inf, 0.2)
    errors[4] = 0.0  # no standard error either
    wrong = np.where(np.isinf(errors) | (errors == 0), 1e6, slopes)
    np.testing.assert_allclose(
        reconstructor.weighted(wrong, errors), reconstructor.weighted(slopes, errors), atol=1e-9
    )
    np.testing.assert_array_equal(reconstructor.weighted(slopes, np.full(40, np.inf)), np.zeros(12))
    np.testing.assert_array_equal(reconstructor.weighted(slopes, np.full(40, np.nan)), np.zeros(12))


def test_weights_lower_the_error() -> None:
    rng = np.random.default_rng(6)
    matrix = _matrix()
    reconstructor = make_reconstructor(matrix, 1e6)
    errors = np.where(np.arange(40) % 2, 2.0, 0.1)
    plain, weighted = [], []
    for _ in range(50):
        command = rng.standard_normal(12)
        slopes = matrix @ command + errors * rng.standard_normal(40)
        plain.append(np.sum((reconstructor(slopes) - command) ** 2))
        weighted.append(np.sum((reconstructor.weighted(slopes, errors) - command) ** 2))
    assert np.mean(weighted) < 0.5 * np.mean(plain)


def test_more_commands_than_slopes_are_refused() -> None:
    with refused("41 commands", "40 slopes"):
        check_controllable(41, 40)
    with refused("12 commands"):
        make_reconstructor(_matrix(10))


@pytest.mark.parametrize("matrix", [np.zeros((4, 2)), np.ones(4), np.full((4, 2), np.nan)])
def test_bad_matrices_are_refused(matrix: np.ndarray) -> None:
    with refused("interaction"):
        make_reconstructor(matrix)


def test_slopes_without_noise_are_hardly_damped() -> None:
    matrix = _matrix()
    command = np.random.default_rng(2).standard_normal(12)
    reconstructor = make_reconstructor(matrix, 1e6)
    left = np.linalg.norm(reconstructor.clean @ matrix @ command - command)
    assert left < 0.3 * np.linalg.norm(reconstructor(matrix @ command) - command)


def test_of_many_actuators_low_orders_are_corrected_as_well() -> None:
    """They move slopes a tenth as much as others; of few actuators, these would be among the noisiest."""
    corrected = [make_reconstructor(np.diag(np.linspace(0.1, 1.0, n)))(np.eye(n)[0])[0] for n in (100, 1000)]
    few, many = 0.1 * np.array(corrected)
    assert few < 0.5
    assert many > 1.3 * few
