import numpy as np
import pytest
from tests.loop.control.control_cases import ERRORS, INTERACTION

from faintspot.base.flags import SubapertureFlag
from faintspot.loop.control.base import CommandDelayLine
from faintspot.loop.control.integrator import (
    INVALID_PART,
    MEAN_SQUARE,
    CompiledIntegrator,
    Integrator,
    true_slopes,
)
from faintspot.loop.control.reconstructor import make_reconstructor

N, ONE = 9, np.ones((2, 1))


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


def test_stability_with_two_frames_of_delay() -> None:
    """z^2 - z + g = 0 has roots of modulus sqrt(g): stable below 1."""
    for gain, stable in ((0.9, True), (1.1, False)):
        integrator, line = _integrator(2, gain)
        for _ in range(400):
            residual = 1.0 + line.acting
            integrator.follow(residual)
        assert (abs(residual[0]) < 1e-3) == stable


def test_the_compiled_integrator_is_the_plain_one() -> None:
    reconstructor = make_reconstructor(INTERACTION)
    lines = [CommandDelayLine(INTERACTION.shape[1], 2) for _ in range(2)]
    plain = Integrator(lines[0], INTERACTION, reconstructor, 0.3, 0.02)
    compiled = CompiledIntegrator(lines[1], INTERACTION, reconstructor.matrix, 0.3, 0.02)
    rng = np.random.default_rng(3)
    for _ in range(20):
        slopes = rng.standard_normal(2 * N)
        np.testing.assert_allclose(compiled.expected().mean_px, plain.expected().mean_px, atol=1e-6)
        for each in (plain, compiled):
            each.update(slopes, ERRORS)
        np.testing.assert_allclose(lines[1].latest, lines[0].latest, atol=1e-6)  # float32


def test_nothing_winds_up() -> None:
    """After a long time at the stroke it leaves it with the first slope of the other sign."""
    line = CommandDelayLine(1, 1, 5.0)
    integrator = CompiledIntegrator(line, np.ones((2, 1)), np.full((1, 2), 0.5), 0.5, 0.0)
    for _ in range(1000):
        integrator.update(np.full(2, -1e3), np.ones(2))
    assert line.latest[0] == 5.0
    integrator.update(np.full(2, 2.0), np.ones(2))
    assert line.latest[0] == pytest.approx(4.0)


def test_what_is_not_valid_is_not_measured() -> None:
    rng = np.random.default_rng(1)
    x, y = rng.standard_normal((2, N)).astype(np.float32)
    error = np.full(N, 0.5, np.float32)
    flags = np.zeros(N, np.uint8)
    flags[[2, 5]] = SubapertureFlag.NO_FLUX, SubapertureFlag.TOO_MANY_BAD_PIXELS
    flags[7] = SubapertureFlag.SATURATED  # only informs
    x[2], y[3] = 100.0, np.nan
    slopes, errors, covariance, said = (np.full(size, 9.0) for size in (2 * N, 2 * N, N, 2))
    true_slopes(x, y, flags, error, error, 0.1 * error, 0.5, slopes, errors, covariance, said)
    lost = np.tile(np.isin(np.arange(N), [2, 3, 5]), 2)
    np.testing.assert_array_equal(slopes[lost], 0.0)
    np.testing.assert_array_equal(np.isinf(errors), lost)
    np.testing.assert_allclose(slopes[~lost], np.concatenate([x, y])[~lost] / 0.5)
    np.testing.assert_array_equal(errors[~lost], 1.0)
    np.testing.assert_allclose(covariance, np.where(lost[:N], 0.0, 0.2))
    assert said[INVALID_PART] == pytest.approx(3 / 9)
    assert said[MEAN_SQUARE] == pytest.approx(np.square(slopes[~lost]).mean())


def test_no_valid_slope_at_all() -> None:
    slopes, errors, covariance, said = (np.ones(size) for size in (2 * N, 2 * N, N, 2))
    zeros = np.zeros(N, np.float32)
    known = zeros, zeros, np.ones(N, np.uint8), zeros, zeros, zeros
    true_slopes(*known, 1.0, slopes, errors, covariance, said)
    assert said.tolist() == [1.0, 0.0]
    assert not slopes.any()
