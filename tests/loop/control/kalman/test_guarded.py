from functools import partial

import numpy as np
import pytest
from tests.loop.control.control_cases import INTERACTION, PHASE, PLANT, telemetry
from tests.loop.control.naive_guarded import Guarded

from faintspot.loop.control.base import CommandDelayLine, Controller
from faintspot.loop.control.integrator import Make
from faintspot.loop.control.kalman.guard import MOST_EXCESS

FRAMES = telemetry(900, 0.2)


class Runaway(Controller):
    """A controller that has learnt nonsense."""

    undoes_prior = True

    def update(self, slopes_px: np.ndarray, standard_error_px: np.ndarray, covariance: object = None) -> None:
        self.line.put(0.9 * self.line.latest + 0.4 * (PLANT.reconstructor(slopes_px)))


def _guarded(line: CommandDelayLine, learnt: Make, prior: np.ndarray | None = None) -> Guarded:
    return Guarded(line, INTERACTION, PHASE, learnt, partial(PLANT.integrator, 0.4), prior_std_px=prior)


def test_after_a_failure_the_plain_controller_continues_from_the_mirrors_commands() -> None:
    """Its own commands, made for a mirror that exists only in numbers, may be far from them."""
    line = CommandDelayLine(12, 2)
    guarded = _guarded(line, partial(Runaway, interaction=INTERACTION))
    plain = guarded._lines[1]
    for number, slopes in enumerate(FRAMES.open_loop_px[:15]):
        if number == 10:
            assert np.abs(plain.latest - line.latest).max() > 0.1
            guarded._guard["excess"] = 2 * MOST_EXCESS
        guarded.update(slopes + INTERACTION @ line.acting, np.full(18, 0.2))
        if number >= 10:
            assert guarded.chosen == 1
            np.testing.assert_array_equal(plain.latest, line.latest)
            np.testing.assert_array_equal(plain.acting, line.acting)


class Still(Controller):
    """A controller whose command is always the same."""

    undoes_prior = True

    def __init__(self, line: CommandDelayLine, value: float) -> None:
        super().__init__(line, INTERACTION)
        self._command = np.full(12, value)

    def update(self, slopes_px: np.ndarray, standard_error_px: np.ndarray, covariance: object = None) -> None:
        self.line.put(self._command)


def test_commands_go_over_from_one_controller_to_another_in_equal_steps() -> None:
    """From 0.5 of another one to the 1 of the first controller, then to the 0 of the second."""
    line, sent = CommandDelayLine(12, 2), []
    makers = partial(Still, value=1.0), partial(Still, value=0.0)
    guarded = Guarded(line, INTERACTION, PHASE, *makers)
    line.hold(np.full(12, 0.5))
    guarded.begin()
    guarded.hand_over()
    for number in range(30):
        if number == 15:
            guarded.fall_back()
        guarded.update(np.zeros(18), np.full(18, 0.2))
        sent.append(line.latest[0])
    wanted = [*np.linspace(0.55, 1.0, 10), *[1.0] * 5, *np.linspace(0.9, 0.0, 10), *[0.0] * 5]
    np.testing.assert_allclose(sent, wanted, atol=1e-12)


@pytest.mark.parametrize("prior", [None, np.full(18, 0.5)])
def test_alike_nothing_changes(prior: np.ndarray | None) -> None:
    """Two integrators that differ by nothing; posteriors are drawn to what each expects."""
    lines = [CommandDelayLine(12, 2) for _ in range(2)]
    guarded, alone = (
        _guarded(lines[0], partial(PLANT.integrator, 0.4), prior),
        PLANT.integrator(0.4, lines[1]),
    )
    noise = 0.2
    share = 1.0 if prior is None else 0.5**2 / (0.5**2 + noise**2)
    for slopes in FRAMES.open_loop_px[:300]:
        for controller, line in zip((guarded, alone), lines, strict=True):
            mean = controller.expected().mean_px
            posterior = mean + share * (slopes + INTERACTION @ line.acting - mean)
            controller.update(posterior, np.full(18, noise * np.sqrt(share)))
    assert guarded.chosen == 0
    np.testing.assert_allclose(lines[0].latest, lines[1].latest, atol=1e-6)
