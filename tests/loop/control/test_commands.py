import numpy as np
import pytest

from faintspot.loop.control.base import CommandDelayLine


@pytest.mark.parametrize("delay", [1, 2, 5])
def test_a_command_acts_after_the_delay(delay: int) -> None:
    line, acted = CommandDelayLine(1, delay), []
    for frame in range(1, 12):
        acted.append(float(line.acting[0]))
        line.put(np.array([float(frame)]))
        assert line.latest[0] == frame
    assert acted == [0.0] * delay + list(range(1, 12 - delay))


def test_no_command_is_beyond_the_stroke() -> None:
    line = CommandDelayLine(3, 2, 10.0)
    line.put(np.array([5.0, 20.0, -1e30]))
    np.testing.assert_array_equal(line.latest, [5.0, 10.0, -10.0])
    line.hold(np.array([0.0, 99.0, -99.0]))
    np.testing.assert_array_equal(line.acting, [0.0, 10.0, -10.0])
    np.testing.assert_array_equal(line.latest, line.acting)


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf])
def test_a_command_that_is_not_finite_is_not_sent(wrong: float) -> None:
    """Not even at the stroke: it does not say in which direction the mirror should go."""
    line = CommandDelayLine(2, 1, 10.0)
    line.put(np.array([1.0, 2.0]))
    with pytest.raises(ArithmeticError):
        line.put(np.array([wrong, 3.0]))
    np.testing.assert_array_equal(line.latest, [1.0, 2.0])
    np.testing.assert_array_equal(line.acting, [1.0, 2.0])


def test_what_the_caller_does_with_its_array_later_does_not_matter() -> None:
    line, command = CommandDelayLine(2, 2), np.ones(2)
    line.put(command)
    command[:] = 7.0
    np.testing.assert_array_equal(line.latest, 1.0)
