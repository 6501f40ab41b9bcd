"""The guarded filter of large sensors is `Guarded` with the same two controllers."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest
from tests.control.control_cases import (
    FRAME_S,
    INTERACTION,
    PHASE,
    PHASE_OF_COMMANDS,
    PLANT,
    TURBULENCE,
    telemetry,
)

from faintspot.control.commands import CommandDelayLine
from faintspot.control.guarded import Guarded
from faintspot.control.large_guarded import LargeGuarded
from faintspot.control.local_kalman import LocalPredictor, local_filter
from faintspot.control.predictive import Predictive

M, COMMANDS = INTERACTION.shape
GAIN, FRAMES = 0.4, telemetry(250)


@pytest.fixture(scope="module")
def both() -> tuple[list[Guarded], list[CommandDelayLine]]:
    """Return the controllers, plain and fast, of a filter with the wrong sign in its weights."""
    arrays = local_filter(TURBULENCE.layers(), FRAME_S, np.full(M, 0.25))
    arrays = {**arrays, "weights": -0.5 * arrays["weights"]}
    lines = [CommandDelayLine(COMMANDS, 2, 0.8) for _ in range(2)]
    options: dict[str, Any] = {"prior_std_px": np.full(M, 0.7), "noise_factor": 1.3}

    def learnt(line: CommandDelayLine) -> Predictive:
        return Predictive(
            line, INTERACTION, LocalPredictor(arrays), PLANT.reconstructor.clean, from_latest=True
        )

    plain = partial(PLANT.integrator, GAIN)
    fast = LargeGuarded(
        lines[1],
        INTERACTION,
        PLANT.reconstructor,
        PHASE_OF_COMMANDS,
        arrays,
        GAIN,
        PLANT.leak,
        **options,
    )
    slow = Guarded(lines[0], INTERACTION, PHASE, learnt, plain, **options)
    return [slow, fast], lines


def test_it_does_the_same_before_and_after_the_integrator_takes_over(
    both: tuple[list[Guarded], list[CommandDelayLine]],
) -> None:
    """The tolerances are those of float32 in a filter that diverges."""
    controllers, lines = both
    rng, chosen = np.random.default_rng(2), []
    for number, slopes in enumerate(FRAMES.open_loop_px):
        error: np.ndarray = np.where(rng.random(M) < 0.1, np.inf, 0.3 * rng.uniform(0.5, 1.5, M))
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
    assert np.abs(lines[1].latest).max() > 0.1
