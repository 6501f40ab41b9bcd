from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from faintspot.errors import InputError
from faintspot.loop.configuration import Control
from faintspot.loop.control import Integrator, check_controllable, make_reconstructor


def _matrix(slopes: int = 40, commands: int = 12) -> np.ndarray:
    return np.random.default_rng(1).standard_normal((slopes, commands))


@given(delay=st.integers(1, 5), gain=st.floats(0.1, 1.0))
def test_a_command_acts_delay_frames_after_its_frame(delay: int, gain: float) -> None:
    integrator = Integrator(Control(delay_frames=delay, leak=0.0), 1)
    held = []
    for frame in range(10):
        held.append(float(integrator.acting[0]))
        integrator.update(np.array([1.0 if frame == 3 else 0.0]), gain)
    np.testing.assert_allclose(held, [-gain if frame >= 3 + delay else 0.0 for frame in range(10)])


def test_closed_loop_recursion() -> None:
    integrator = Integrator(Control(delay_frames=2, leak=0.1), 1)
    commands = [0.0, 0.0]
    for frame in range(8):
        assert integrator.acting[0] == pytest.approx(commands[frame])
        integrator.update(np.array([1.0 + commands[frame]]), 0.3)
        commands.append(0.9 * commands[-1] - 0.3 * (1.0 + commands[frame]))


def test_open_loop_is_a_running_mean() -> None:
    integrator = Integrator(Control(mode="open", leak=0.5), 1)
    for _ in range(40):
        integrator.update(np.array([7.0]), 0.4)
    assert integrator.acting[0] == pytest.approx(-7)


def test_the_expected_wavefront_is_what_is_not_yet_taken_off() -> None:
    integrator = Integrator(Control(leak=0.0), 1)
    integrator.update(np.array([10.0]), 0.5)
    assert integrator.expected()[0] == pytest.approx(5.0)  # a wavefront of 5 is still to be taken off
    integrator.update(np.array([0.0]), 0.5)
    assert integrator.expected()[0] == pytest.approx(0.0)


@pytest.mark.parametrize(("gain", "stable"), [(0.9, True), (1.1, False)])
def test_stability_with_two_frames_of_delay(gain: float, stable: bool) -> None:
    """z^2 - z + g = 0 has roots of modulus sqrt(g): stable below 1."""
    integrator = Integrator(Control(leak=0.0), 1)
    residual = np.array([1.0])
    for _ in range(400):
        residual = 1.0 + integrator.acting
        integrator.update(residual, gain)
    assert (abs(residual[0]) < 1e-3) == stable


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
    wrong = np.where(np.isinf(errors), 1e6, slopes)
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
    with pytest.raises(InputError, match=r"41 commands .* more than 40 slopes"):
        check_controllable(41, 40)
    with pytest.raises(InputError, match="12 commands"):
        make_reconstructor(_matrix(10))


@pytest.mark.parametrize("matrix", [np.zeros((4, 2)), np.ones(4), np.full((4, 2), np.nan)])
def test_bad_matrices_are_refused(matrix: np.ndarray) -> None:
    with pytest.raises(InputError, match="interaction"):
        make_reconstructor(matrix)
