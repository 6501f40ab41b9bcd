"""The guarded filter of large sensors is `Guarded` with the same two controllers."""

from functools import partial
from typing import Any

import numpy as np
import pytest
from tests.loop.control.control_cases import (
    FRAME_S,
    INTERACTION,
    PHASE,
    PHASE_OF_COMMANDS,
    PLANT,
    TURBULENCE,
    telemetry,
)
from tests.loop.control.naive_guarded import Guarded

from faintspot.loop.control import integrator
from faintspot.loop.control.base import CommandDelayLine
from faintspot.loop.control.kalman.compiled import Predictive
from faintspot.loop.control.kalman.guarded import EXCESS, MOST_EXCESS, GuardedController
from faintspot.loop.control.kalman.local_predictor import LocalPredictor, local_filter
from faintspot.loop.control.kalman.modal_predictor import LargeGuarded
from faintspot.slopes.kernels.products import add_slopes

M, COMMANDS = INTERACTION.shape
GAIN, FRAMES = 0.4, telemetry(250)


def wrong_filter() -> dict[str, Any]:
    """Return the arrays of a filter with the wrong sign in its weights."""
    arrays = local_filter(TURBULENCE.layers(), FRAME_S, np.full(M, 0.25))
    return {**arrays, "weights": -0.5 * arrays["weights"]}


@pytest.fixture
def both() -> tuple[list[GuardedController], list[CommandDelayLine]]:
    """Return the controllers, plain and fast."""
    arrays = wrong_filter()
    lines = [CommandDelayLine(COMMANDS, 2, 0.8) for _ in range(2)]
    options: dict[str, Any] = {"prior_std_px": np.full(M, 0.7), "noise_factor": 1.3}

    def learnt(line: CommandDelayLine) -> Predictive:
        return Predictive(
            line, INTERACTION, LocalPredictor(arrays), PLANT.reconstructor.clean, from_latest=True
        )

    plain = partial(PLANT.integrator, GAIN)
    fast = LargeGuarded(
        lines[1],
        PLANT,
        PHASE_OF_COMMANDS,
        arrays,
        GAIN,
        **options,
    )
    slow = Guarded(lines[0], INTERACTION, PHASE, learnt, plain, **options)
    return [slow, fast], lines


@pytest.mark.parametrize("fails", [False, True], ids=["computed", "measured"])
def test_it_does_the_same_before_and_after_the_integrator_takes_over(
    both: tuple[list[GuardedController], list[CommandDelayLine]], fails: bool
) -> None:
    """By computed residuals, or because the filter's measured one is too large.

    The tolerances are those of float32 in a filter that diverges.
    """
    controllers, lines = both
    rng, chosen = np.random.default_rng(2), []
    for number, slopes in enumerate(FRAMES.open_loop_px):
        error: np.ndarray = np.where(rng.random(M) < 0.1, np.inf, 0.3 * rng.uniform(0.5, 1.5, M))
        if fails and number == 10:
            for controller in controllers:
                controller._guard[EXCESS] = 2 * MOST_EXCESS
        if number == 200:
            for controller, line in zip(controllers, lines, strict=True):
                line.hold(np.full(COMMANDS, 0.1))
                controller.begin()
        for controller, line in zip(controllers, lines, strict=True):
            controller.update(np.where(np.isfinite(error), slopes + INTERACTION @ line.acting, 0.0), error)
        np.testing.assert_allclose(lines[1].latest, lines[0].latest, rtol=1e-4, atol=5e-4)
        expected = [each.expected() for each in controllers]
        np.testing.assert_allclose(expected[1].mean_px, expected[0].mean_px, rtol=1e-4, atol=5e-4)
        assert (expected[1].std_px is None) == (expected[0].std_px is None)
        assert controllers[0].chosen == controllers[1].chosen
        chosen.append(controllers[0].chosen)
    assert chosen[0] == 0
    assert chosen[-1] == 1
    assert (chosen[9:11] == [0, 1]) == fails
    assert np.abs(lines[1].latest).max() > 0.1


def test_a_command_that_is_begun_while_slopes_are_measured_is_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Both of the filter and of the integrator that takes over; the tolerance is that of float32."""
    monkeypatch.setattr(integrator, "_LEAST_BYTES", 0)
    arrays, rng, chosen = wrong_filter(), np.random.default_rng(3), []
    lines = [CommandDelayLine(COMMANDS, 2, 0.8) for _ in range(2)]
    others = PLANT, PHASE_OF_COMMANDS, arrays, GAIN
    whole, begun = (LargeGuarded(line, *others, noise_factor=1.3) for line in lines)
    n = M // 2
    for number, open_loop in enumerate(FRAMES.open_loop_px):
        slopes = (2.0 * (open_loop + INTERACTION @ lines[0].acting)).astype(np.float32)
        flags = (rng.random(n) < 0.1).astype(np.uint8)
        valid = np.tile(flags == 0, 2)
        error: np.ndarray = np.where(valid, 0.3, np.inf)
        parts = begun.begin_product(2, 0.5)
        assert len(parts) == (2 if number else 0)
        last = rng.integers(n)  # the rest has not been measured in time
        for part in parts[:1]:
            add_slopes(part, slopes[:n], slopes[n:], flags, 0, last)
        flags[0] = 1  # found out after the frame
        valid[[0, n]] = False
        true = np.where(valid, 0.5 * slopes.astype(np.float64), 0.0)
        for controller in (whole, begun):
            controller.update(true, np.where(valid, error, np.inf))
        np.testing.assert_allclose(lines[1].latest, lines[0].latest, rtol=1e-4, atol=1e-4)
        for controller in (whole, begun):
            controller.expected()
        assert whole.chosen == begun.chosen
        chosen.append(begun.chosen)
    assert chosen[0] == 0
    assert chosen[-1] == 1


def test_nothing_is_begun_with_a_prior_or_before_the_frame_is_complete(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(integrator, "_LEAST_BYTES", 0)
    line = CommandDelayLine(COMMANDS, 2, 0.8)
    others = PLANT, PHASE_OF_COMMANDS, wrong_filter(), GAIN
    controller = LargeGuarded(line, *others)
    controller.update(np.zeros(M), np.full(M, 0.3))
    assert not controller.begin_product(1, 1.0)
    controller.expected()
    assert controller.begin_product(1, 1.0)
    line.put(line.latest)  # of a frame that was lost
    assert not controller.begin_product(1, 1.0)
    controller.expected()
    controller.prior_std_px = np.full(M, 0.7)
    assert not controller.begin_product(1, 1.0)
