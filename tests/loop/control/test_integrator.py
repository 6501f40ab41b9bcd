import numpy as np
import pytest

from faintspot.loop.control.base import CommandDelayLine
from faintspot.loop.control.integrator import Integrator
from faintspot.loop.control.reconstructor import make_reconstructor

ONE = np.ones((2, 1))


def _integrator(
    delay: int = 2, gain: float = 0.5, leak: float = 0.0, *, sees_mirror: bool = True
) -> tuple[Integrator, CommandDelayLine]:
    line = CommandDelayLine(1, delay)
    return Integrator(line, ONE, make_reconstructor(ONE), gain, leak, sees_mirror=sees_mirror), line


def test_closed_loop_recursion() -> None:
    integrator, line = _integrator(2, 0.3, 0.1)
    commands = [0.0, 0.0]
    for frame in range(8):
        assert line.acting[0] == pytest.approx(commands[frame])
        integrator.follow(np.array([1.0 + commands[frame]]))
        commands.append(0.9 * commands[-1] - 0.3 * (1.0 + commands[frame]))


def test_open_loop_is_a_running_mean() -> None:
    integrator, line = _integrator(2, 0.4, 0.5, sees_mirror=False)
    for _ in range(40):
        integrator.follow(np.array([7.0]))
    assert line.acting[0] == pytest.approx(-7)
    np.testing.assert_allclose(integrator.expected().mean_px, 7.0)


def test_the_expected_slopes_are_what_is_not_yet_taken_off() -> None:
    integrator, _ = _integrator()
    integrator.follow(np.array([10.0]))
    np.testing.assert_allclose(integrator.expected().mean_px, 5.0)  # 5 are still to be taken off
    integrator.follow(np.array([0.0]))
    np.testing.assert_allclose(integrator.expected().mean_px, 0.0)


@pytest.mark.parametrize(("gain", "stable"), [(0.9, True), (1.1, False)])
def test_stability_with_two_frames_of_delay(gain: float, stable: bool) -> None:
    """z^2 - z + g = 0 has roots of modulus sqrt(g): stable below 1."""
    integrator, line = _integrator(2, gain)
    residual = np.array([1.0])
    for _ in range(400):
        residual = 1.0 + line.acting
        integrator.follow(residual)
    assert (abs(residual[0]) < 1e-3) == stable
