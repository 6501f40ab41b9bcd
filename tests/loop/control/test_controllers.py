"""What every controller must do: one suite, and a class for each controller."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from tests.loop.control.control_cases import (
    FRAME_S,
    INTERACTION,
    MODEL,
    PHASE,
    PHASE_OF_COMMANDS,
    PLANT,
    TURBULENCE,
)

from faintspot.loop.control.base import CommandDelayLine
from faintspot.loop.control.integrator import CompiledIntegrator
from faintspot.loop.control.kalman.compiled import CompiledKalman
from faintspot.loop.control.kalman.local_predictor import local_filter
from faintspot.loop.control.kalman.modal_predictor import LargeGuarded
from faintspot.loop.control.kalman.predictor import SlopePredictor

M, COMMANDS = INTERACTION.shape
GAIN = 0.4
ERRORS = np.full(M, 0.2)


class ControllerTests:
    """Tests of a controller; a subclass makes it."""

    left = 0.1
    """Largest rms that may be left of a wavefront that stays, over its own."""
    lost = 0.5
    """Largest part of the commands that three frames without slopes may change."""

    def make(self, line: CommandDelayLine) -> Any:
        """Return the controller, which sends its commands to the line."""
        raise NotImplementedError

    def made(self) -> tuple[Any, CommandDelayLine]:
        line = CommandDelayLine(COMMANDS, 2)
        return self.make(line), line

    def driven(
        self, controller: Any, line: CommandDelayLine, frames: int, seed: int = 1
    ) -> NDArray[np.float64]:
        """Return the commands of some frames of the same wavefront with noise, (frames, commands)."""
        rng = np.random.default_rng(seed)
        wavefront = np.linspace(-1.0, 1.0, COMMANDS)
        sent = []
        for _ in range(frames):
            controller.expected()
            slopes = INTERACTION @ (wavefront + line.acting) + 0.01 * rng.standard_normal(M)
            controller.update(slopes, ERRORS)
            sent.append(line.latest.copy())
        return np.array(sent)

    def test_a_wavefront_that_stays_is_taken_off(self) -> None:
        wavefront = np.linspace(-1.0, 1.0, COMMANDS)
        sent = self.driven(*self.made(), 200)
        assert np.linalg.norm(sent[-1] + wavefront) < self.left * np.linalg.norm(wavefront)

    def test_equal_slopes_give_equal_commands(self) -> None:
        np.testing.assert_array_equal(self.driven(*self.made(), 20), self.driven(*self.made(), 20))

    def test_what_is_given_stays_as_it_is(self) -> None:
        controller, _ = self.made()
        slopes, errors = np.linspace(-1.0, 1.0, M), ERRORS.copy()
        errors[3] = np.inf
        covariance = np.full(M // 2, 0.01)
        given = [array.copy() for array in (slopes, errors, covariance)]
        controller.update(slopes, errors, covariance)
        for array, before in zip((slopes, errors, covariance), given, strict=True):
            np.testing.assert_array_equal(array, before)

    def test_expected_slopes_are_finite_numbers_of_all_slopes(self) -> None:
        controller, line = self.made()
        self.driven(controller, line, 5)
        mean, std = controller.expected()
        assert mean.shape == (M,)
        assert np.isfinite(mean).all()
        assert std is None or (std.shape == (M,) and (std >= 0).all())

    def test_frames_without_any_slope_change_little(self) -> None:
        """Commands stay finite, and near what they were."""
        controller, line = self.made()
        before = self.driven(controller, line, 30)[-1]
        for _ in range(3):
            controller.expected()
            controller.update(np.zeros(M), np.full(M, np.inf))
        assert np.isfinite(line.latest).all()
        assert np.linalg.norm(line.latest - before) < self.lost * np.linalg.norm(before)

    def test_begun_anew_it_remembers_nothing(self) -> None:
        """Whatever came before, commands follow from those that the line holds."""
        sent = []
        for seed in (1, 2):
            controller, line = self.made()
            self.driven(controller, line, 25, seed)
            line.hold(np.full(COMMANDS, 0.3))
            controller.begin()
            sent.append(self.driven(controller, line, 10, 3))
        np.testing.assert_allclose(sent[0], sent[1], atol=1e-6)


class TestIntegrator(ControllerTests):
    def make(self, line: CommandDelayLine) -> Any:
        return PLANT.integrator(GAIN, line)


class TestCompiledIntegrator(ControllerTests):
    def make(self, line: CommandDelayLine) -> Any:
        return CompiledIntegrator(line, INTERACTION, PLANT.reconstructor.matrix, GAIN, PLANT.leak)


class TestCompiledKalman(ControllerTests):
    def make(self, line: CommandDelayLine) -> Any:
        return CompiledKalman(line, PLANT, PHASE, SlopePredictor(MODEL, ERRORS**2), GAIN)


class TestLargeGuarded(ControllerTests):
    def make(self, line: CommandDelayLine) -> Any:
        arrays = local_filter(TURBULENCE.layers(), FRAME_S, ERRORS**2)
        return LargeGuarded(line, PLANT, PHASE_OF_COMMANDS, arrays, GAIN)
