"""The compiled Kalman filter is the one written in NumPy, with the integrator that guards it."""

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from tests.loop.control.control_cases import INTERACTION, LAYERS, MODEL, PHASE, PLANT, telemetry
from tests.loop.control.naive_guarded import Guarded

from faintspot.loop.control.base import CommandDelayLine
from faintspot.loop.control.kalman.compiled import STEPS, CompiledKalman, Predictive
from faintspot.loop.control.kalman.guard import HANDOVER_FRAMES
from faintspot.loop.control.kalman.predictor import SlopeModel, SlopePredictor

M, COMMANDS = INTERACTION.shape
USUAL_PX2, GAIN, FRAMES = 0.25, 0.4, telemetry(500)
Both = list[tuple[Any, CommandDelayLine]]


def both(model: SlopeModel = MODEL, largest: float = 1e30, steps: int = STEPS, **options: Any) -> Both:
    """Return the filter in NumPy and the compiled one, each with where its commands go."""
    lines = [CommandDelayLine(COMMANDS, 2, largest) for _ in range(2)]
    clean = PLANT.reconstructor.clean

    def predictor() -> SlopePredictor:
        return SlopePredictor(model, np.full(M, USUAL_PX2), np.full(M // 2, 0.5 * USUAL_PX2))

    def learnt(line: CommandDelayLine) -> Predictive:
        return Predictive(line, INTERACTION, predictor(), clean)

    plain = partial(PLANT.integrator, GAIN)
    slow = Guarded(lines[0], INTERACTION, PHASE, learnt, plain, **options)
    fast = CompiledKalman(lines[1], PLANT, PHASE, predictor(), GAIN, steps=steps, **options)
    return list(zip((slow, fast), lines, strict=True))


def noise(rng: np.random.Generator, largest: float) -> tuple[np.ndarray, np.ndarray]:
    """Return errors, a tenth infinite, and covariances of x and y: correlations of 0.2 to 0.8."""
    error: np.ndarray = np.minimum(0.5 * rng.uniform(0.5, 2.0, M), largest)
    error[rng.random(M) < 0.1] = np.inf
    x, y = np.split(np.where(np.isfinite(error), error, 0.0), 2)
    return error, rng.uniform(0.2, 0.8, M // 2) * x * y


@pytest.mark.slow
@pytest.mark.parametrize("prior", [None, np.full(M, 0.5)])
@pytest.mark.parametrize(("steps", "tolerance"), [(STEPS, 3e-3), (30, 1e-7)])
@pytest.mark.parametrize("model", [MODEL, LAYERS], ids=["one layer", "two layers"])
def test_it_is_the_filter_in_numpy(
    model: SlopeModel, prior: np.ndarray | None, steps: int, tolerance: float
) -> None:
    """Commands, of up to 1.5, and what is expected: four steps of conjugate gradients leave up to 3e-3 where
    noise differs that much, 30 steps only rounding.
    """
    rng, largest = np.random.default_rng(2), 0.45
    controllers = both(model, steps=steps, prior_std_px=prior, noise_factor=1.3)
    for slopes in FRAMES.open_loop_px:
        error, covariance = noise(rng, 9.0 if prior is None else largest)
        expected = []
        for controller, line in controllers:
            expected.append(controller.expected())
            seen = np.where(np.isfinite(error), slopes + INTERACTION @ line.acting, 0.0)
            controller.update(seen, error, covariance)
        np.testing.assert_allclose(expected[1].mean_px, expected[0].mean_px, rtol=0, atol=5 * tolerance)
        np.testing.assert_array_equal(expected[1].std_px, expected[0].std_px)
        np.testing.assert_allclose(controllers[1][1].latest, controllers[0][1].latest, rtol=0, atol=tolerance)
    assert np.abs(controllers[0][1].latest).max() > 0.1
    assert controllers[0][0].chosen == controllers[1][0].chosen
    assert prior is not None or controllers[0][0].chosen == 0  # these slopes were not drawn to a prior


def test_nonsense_is_replaced_by_the_integrator() -> None:
    """A model with the wrong sign: after some frames the mirror has the integrator's commands."""
    wrong = replace(MODEL, first=-MODEL.first)
    (slow, one), (fast, other) = both(wrong, largest=0.8)
    line = CommandDelayLine(COMMANDS, 2, 0.8)
    plain = PLANT.integrator(GAIN, line)
    took_over = 0
    for number, slopes in enumerate(FRAMES.open_loop_px[:300]):
        plainly = fast.chosen
        for controller, own in ((slow, one), (fast, other), (plain, line)):
            controller.update(slopes + INTERACTION @ own.acting, np.full(M, 0.5))
        if plainly:
            took_over = took_over or number
        if took_over and number >= took_over + HANDOVER_FRAMES:
            np.testing.assert_allclose(other.latest, line.latest, rtol=0, atol=1e-9)
            assert fast.expected().std_px is None
        np.testing.assert_allclose(other.latest, one.latest, rtol=0, atol=2e-3)
        np.testing.assert_allclose(fast.expected().mean_px, slow.expected().mean_px, rtol=0, atol=2e-3)
        assert fast.chosen == slow.chosen
    assert 20 <= took_over < 200
    assert np.abs(line.latest).max() <= 0.8


@pytest.mark.parametrize(("prefers_plain", "tolerance"), [(False, 1e-3), (True, 1e-9)])
def test_it_begins_from_what_the_mirror_holds(prefers_plain: bool, tolerance: float) -> None:
    """Without a single slope, from frame 20 on, the filter goes on by itself."""
    controllers = both(prefers_plain=prefers_plain)
    for controller, line in controllers:
        line.hold(np.linspace(-1.0, 1.0, COMMANDS))
        controller.begin()
    for number, slopes in enumerate(FRAMES.open_loop_px[:30]):
        error = np.full(M, 0.5 if number < 20 else np.inf)
        for controller, line in controllers:
            controller.update((slopes + INTERACTION @ line.acting) * np.isfinite(error), error)
        latest = [line.latest for _, line in controllers]
        np.testing.assert_allclose(latest[1], latest[0], rtol=0, atol=tolerance)
    assert controllers[1][0].chosen == prefers_plain


def test_a_filter_that_runs_away_says_so() -> None:
    """With a model that grows without end, in the end numbers do not suffice; no such command goes out."""
    _, (fast, line) = both(replace(MODEL, first=1e30 * np.eye(M)[None]), largest=1e3)
    for slopes in FRAMES.open_loop_px:
        try:
            fast.update(slopes, np.full(M, 0.5))
        except ArithmeticError:
            break
    else:
        pytest.fail("it went on")
    assert np.isfinite(line.latest).all()
