"""A new controller that follows a running loop until its state has settled, and then takes over."""

from __future__ import annotations

from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from faintspot.loop.control.base import CommandDelayLine, Controller, without_prior
from faintspot.loop.control.configuration import Control
from faintspot.loop.control.options import CONTROLLER

Floats = NDArray[np.float64]


class PreparedController(NamedTuple):
    """A controller that has been prepared."""

    kind: str
    controller: Controller
    predicts: bool
    """Whether its prediction goes to the estimators as a prior."""
    centroid_gain: float
    """Centroid gain by which its slopes are divided."""

    @classmethod
    def of(cls, control: Control) -> Self:
        """Return the configured controller, with a delay line of its own."""
        controller = control.controller(control.line())
        predicts = control.prediction == CONTROLLER
        return cls(control.options.controller, controller, predicts, control.centroid_gain)


class ControllerSuccessor:
    """Controller that follows the frames of a loop beside the controller that drives the mirror.

    Its own commands are sent nowhere: with each frame, its delay line is that of the mirror again. On large
    sensors a frame has no time for two filters: there the controller takes over at once.

    Parameters
    ----------
    ready : PreparedController
        With a guarded controller.
    """

    def __init__(self, ready: PreparedController) -> None:
        self.ready, self._frames = ready, 0
        self.has_failed = False

    @property
    def is_settling(self) -> bool:
        """Whether it has to follow more frames before it can take over."""
        return self._frames < self.ready.controller.settle_frames and not self.has_failed

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
        self.ready.controller.line.copy_from(line, without_latest=True)
        if self._frames == 0:
            self.ready.controller.begin()
        try:
            self.ready.controller.update(alone, np.sqrt(variance), covariance if prior is None else None)
        except ArithmeticError:
            self.has_failed = True
        self._frames += 1

    def take_over(self, line: CommandDelayLine) -> PreparedController:
        """Return the controller, whose commands go on from the mirror's."""
        self.ready.controller.line.copy_from(line)
        if self._frames == 0:
            self.ready.controller.begin()
        self.ready.controller.hand_over()
        return self.ready
