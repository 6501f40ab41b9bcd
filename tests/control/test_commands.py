from __future__ import annotations

import numpy as np
import pytest

from faintspot.control.commands import CommandLine


@pytest.mark.parametrize("delay", [1, 2, 5])
def test_a_command_acts_after_the_delay(delay: int) -> None:
    line, acted = CommandLine(1, delay), []
    for frame in range(1, 12):
        acted.append(float(line.acting[0]))
        line.put(np.array([float(frame)]))
        assert line.latest[0] == frame
    assert acted == [0.0] * delay + list(range(1, 12 - delay))


def test_no_command_is_beyond_the_stroke() -> None:
    line = CommandLine(3, 2, 10.0)
    line.put(np.array([5.0, 20.0, -np.inf]))
    np.testing.assert_array_equal(line.latest, [5.0, 10.0, -10.0])
    line.hold(np.array([0.0, 99.0, -99.0]))
    np.testing.assert_array_equal(line.acting, [0.0, 10.0, -10.0])
    np.testing.assert_array_equal(line.latest, line.acting)


def test_what_the_caller_does_with_its_array_later_does_not_matter() -> None:
    line, command = CommandLine(2, 2), np.ones(2)
    line.put(command)
    command[:] = 7.0
    np.testing.assert_array_equal(line.latest, 1.0)
