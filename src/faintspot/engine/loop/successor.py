"""A new controller that follows a running loop until its state has settled, and then takes over."""

from __future__ import annotations

from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from faintspot.loop.control.commands import CommandDelayLine
from faintspot.loop.control.compiled import CompiledIntegrator
from faintspot.loop.control.configuration import CONTROLLER, Control
from faintspot.loop.control.identification.model import SETTLE_FRAMES
from faintspot.loop.control.kalman.compiled import CompiledKalman
from faintspot.loop.control.kalman.guarded import Guarded
from faintspot.loop.control.kalman.large_guarded import LargeGuarded
from faintspot.loop.control.telemetry import without_prior

Floats = NDArray[np.float64]


class PreparedController(NamedTuple):
    """A controller that has been prepared."""

    kind: str
    controller: Any
    line: CommandDelayLine
    """Delay line that its commands enter."""
    predicts: bool
    """Whether its prediction goes to the estimators as a prior."""
    takes_prior: bool
    """Whether it uses the width of the prior of the slopes."""
    completes: bool
    """Whether a part of each frame's work, which need not delay the command, waits for `expected`."""
    centroid_gain: float
    """Centroid gain by which its slopes are divided."""
    begins: bool
    """Whether it can begin its command while slopes are measured, by `begin_product`."""

    @classmethod
    def of(cls, control: Control) -> Self:
        """Return the configured controller, with a delay line of its own."""
        line = control.line()
        controller = control.controller(line)
        return cls(
            control.options.controller,
            controller,
            line,
            control.prediction == CONTROLLER,
            isinstance(controller, (Guarded, CompiledKalman)),
            isinstance(controller, (LargeGuarded, CompiledKalman)),
            control.centroid_gain,
            isinstance(controller, (CompiledIntegrator, LargeGuarded)),
        )


class ControllerSuccessor:
    """Controller that follows the frames of a loop beside the controller that drives the mirror.

    Its own commands are sent nowhere: with each frame, its delay line is that of the mirror again. On large
    sensors a frame has no time for two filters: there the controller takes over at once.

    Parameters
    ----------
    ready : Ready
        With a guarded controller.
    """

    def __init__(self, ready: PreparedController) -> None:
        self.ready, self._frames = ready, 0
        self._settles_in = 0 if isinstance(ready.controller, LargeGuarded) else SETTLE_FRAMES
        self.has_failed = False

    @property
    def is_settling(self) -> bool:
        """Whether it has to follow more frames before it can take over."""
        return self._frames < self._settles_in and not self.has_failed

    def follow(
        self,
        line: CommandDelayLine,
        slopes: Floats,
        errors: Floats,
        covariance: Floats,
        expected: Floats,
        prior: Floats | None,
    ) -> None:
        """Take a frame whose command has been sent.

        Parameters
        ----------
        line : CommandDelayLine
            To the mirror.
        slopes, errors, covariance : (2 n,), (2 n,) and (n,) arrays
            As for `Controller.update`, divided by this controller's centroid gain.
        expected, prior : (2 n,) array
            Mean and standard deviation of the estimator's prior; None: it had none.
        """
        alone, variance, _ = without_prior(slopes, errors, expected, prior)
        self.ready.line.copy_from(line, without_latest=True)
        if self._frames == 0:
            self.ready.controller.begin()
        try:
            self.ready.controller.update(alone, np.sqrt(variance), covariance if prior is None else None)
        except ArithmeticError:
            self.has_failed = True
        self._frames += 1

    def take_over(self, line: CommandDelayLine) -> PreparedController:
        """Return the controller, whose commands go on from the mirror's."""
        self.ready.line.copy_from(line)
        if self._frames == 0:
            self.ready.controller.begin()
        self.ready.controller.hand_over()
        return self.ready
