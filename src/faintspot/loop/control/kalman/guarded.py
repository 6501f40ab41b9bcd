"""Learnt and plain controller on the same slopes, of which the one with less residual drives the mirror."""

import math
from abc import abstractmethod

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.loop.control.base import CommandDelayLine, Controller
from faintspot.loop.control.faults import StuckWatch
from faintspot.loop.control.kalman.guard import (
    AT_LIMIT,
    CHOOSE,
    HANDOVER_FRAMES,
    INTEGRATOR,
    LEFT_OUT,
    MOST_EXCESS,
    OTHER,
    RESIDUAL,
    new_guard,
    restart,
)


class GuardedController(Controller):
    """Learnt controller, replaced by a plain one while its residual is larger; subclasses compute both.

    Both send commands in every frame, each to a mirror of its own that exists only in numbers; the slopes
    that each would have had follow from the open-loop slopes. So what they leave can be compared in the same
    frames, and either can take over without a jump in its own state. As long as the difference is within its
    error, nothing changes. When another controller takes over, the commands sent differ from its own by an
    offset, which falls from the whole difference to zero in `HANDOVER_FRAMES` equal steps. After a failure by
    its measured residual the plain one continues from the mirror's commands instead.

    Parameters
    ----------
    line : CommandDelayLine
        To the true mirror.
    interaction : (m, commands) array
    prior_std_px : (m,) array, optional
        Prior of the estimator, whose mean is `expected`. Default: it has none.
    noise_factor : float
        What to multiply the variances of standard errors by.
    prefers_plain, plain_residual, plain_frames
        See `guard.new_guard`.
    """

    is_guarded = True

    def __init__(
        self,
        line: CommandDelayLine,
        interaction: Floats,
        *,
        prior_std_px: Floats | None = None,
        noise_factor: float = 1.0,
        prefers_plain: bool = False,
        plain_residual: float = math.inf,
        plain_frames: int = 0,
    ) -> None:
        super().__init__(line, interaction)
        sizes = interaction.shape[1], line.delay_frames, line.largest
        self._lines = [CommandDelayLine(*sizes) for _ in range(2)]
        self.prior_std_px, self._noise_factor = prior_std_px, float(noise_factor)
        self._offset = np.zeros(interaction.shape[1])
        self._watch = StuckWatch(len(interaction))
        self._guard = new_guard(prefers_plain, plain_residual, plain_frames, interaction.shape[1])

    @property
    def chosen(self) -> int:
        """0: the learnt controller; 1: the plain one."""
        self.complete()
        return self._chosen

    @property
    def _chosen(self) -> int:
        """The same, while a frame is not complete."""
        return int(self._guard["chosen"])

    @abstractmethod
    def set_plain_gain(self, gain: float) -> None:
        """Change the gain of the integrator from the next frame on."""

    def fall_back(self) -> None:
        """See `Controller`."""
        self.complete()
        self._guard["chosen"] = INTEGRATOR

    def begin(self) -> None:
        """See `Controller`; both restart from there."""
        for line in self._lines:
            line.hold(self.line.latest)
        restart(self._guard)
        self._guard["sent"] = self._guard["chosen"]

    def hand_over(self) -> None:
        """See `Controller`."""
        self._guard["sent"] = OTHER

    @property
    def is_stuck(self) -> NDArray[np.bool_]:
        """(n,): sub-apertures whose slopes are not used because they are stuck."""
        return self._watch.is_stuck

    def _errors_to_use(self, slopes_px: Floats, standard_error_px: Floats) -> Floats:
        """Return standard errors, infinite for sub-apertures that are stuck."""
        errors = self._watch(slopes_px, standard_error_px)
        self._guard["measures"][LEFT_OUT] = self._watch.left_out
        return errors

    def _choose(self, learnt: float, plain: float) -> bool:
        """Select a controller by the squared residuals; return whether the learnt one has failed.

        The plain one then continues from the mirror's commands: its own are as wrong as the model.
        """
        before = self._chosen
        CHOOSE(self._guard, learnt, plain)
        has_failed = self._chosen > before and bool(self._guard["excess"][RESIDUAL] > MOST_EXCESS)
        if has_failed:
            self._lines[1].copy_from(self.line)
            self._guard["sent"], self._guard["blended"] = INTEGRATOR, 0
        return has_failed

    def _send(self) -> None:
        """Send the chosen controller's command, with what is left of the offset."""
        command, guard = self._lines[self._chosen].latest, self._guard
        if guard["sent"] != guard["chosen"]:
            guard["sent"], guard["blended"] = guard["chosen"], HANDOVER_FRAMES
            self._offset = self.line.latest - command
        guard["blended"] = max(0, guard["blended"] - 1)
        self.line.put(command + guard["blended"] / HANDOVER_FRAMES * self._offset)
        guard["measures"][AT_LIMIT] = np.count_nonzero(np.abs(self.line.latest) >= self.line.largest)
