"""Two controllers on the same slopes, of which the one with the smaller residual drives the mirror."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from faintspot.loop.control.base import Controller, Expected
from faintspot.loop.control.commands import CommandDelayLine
from faintspot.loop.control.telemetry import as_estimated, without_prior

Floats = NDArray[np.float64]

MEMORY_FRAMES = 100
CORRELATED_FRAMES = 5  # over which residuals are alike
FEWEST_FRAMES = 50  # before the first change
STANDARD_ERRORS = 1.0  # by which one must leave less than the other
HANDOVER_FRAMES = 10  # after which a controller's own commands are sent


class Guarded:
    """Learnt controller, replaced by a plain one while its residual is larger.

    Both send commands in every frame, each to a mirror of its own that exists only in numbers; the slopes
    that each would have had follow from the open-loop slopes. So what they leave can be compared in the same
    frames, and either can take over without a jump in its own state. As long as the difference is within its
    error, nothing changes. When another controller takes over, the commands sent differ from its own by an
    offset, which falls from the whole difference to zero in `HANDOVER_FRAMES` equal steps.

    Parameters
    ----------
    line : CommandDelayLine
        To the true mirror.
    interaction : (m, commands) array
    phase : (k, m) array
        From slopes to what is compared, see `residual_phase`.
    learnt, plain : callable
        Return a controller, given where its commands go.
    prior_std_px : (m,) array, optional
        Prior of the estimator, whose mean is `expected`. Default: it has none.
    noise_factor : float
        What to multiply the variances of standard errors by.
    prefers_plain : bool
        Whether the plain one begins.
    """

    undoes_prior = False

    def __init__(
        self,
        line: CommandDelayLine,
        interaction: Floats,
        phase: Floats,
        learnt: Callable[[CommandDelayLine], Controller],
        plain: Callable[[CommandDelayLine], Controller],
        *,
        prior_std_px: Floats | None = None,
        noise_factor: float = 1.0,
        prefers_plain: bool = False,
    ) -> None:
        self._line, self._interaction, self._phase = line, interaction, phase
        sizes = interaction.shape[1], line.delay_frames, line.largest
        self._lines = [CommandDelayLine(*sizes) for _ in range(2)]
        makers = (learnt, plain)
        self.controllers = [make(own_line) for make, own_line in zip(makers, self._lines, strict=True)]
        self.prior_std_px, self._noise_factor = prior_std_px, noise_factor
        self.chosen = int(prefers_plain)
        """0: the learnt controller; 1: the plain one."""
        self._sent: int | None = self.chosen  # whose commands the last frame's were
        self._offset, self._blended = np.zeros(interaction.shape[1]), 0
        self._difference = np.zeros(2)
        self._frames = 0

    def expected(self) -> Expected:
        """See `Controller`."""
        mean, std = self.controllers[self.chosen].expected()
        offset = self._line.acting - self._lines[self.chosen].acting
        return Expected(mean + self._interaction @ offset, std)

    def fall_back(self) -> None:
        """Let the plain controller drive the mirror until the learnt one leaves less."""
        self.chosen = 1

    def begin(self) -> None:
        """See `Controller`; both restart from there."""
        for controller, line in zip(self.controllers, self._lines, strict=True):
            line.hold(self._line.latest)
            controller.begin()
        self._difference[:], self._frames = 0.0, 0
        self._sent, self._blended = self.chosen, 0

    def hand_over(self) -> None:
        """Let the next commands follow on from the latest, which another filter has sent."""
        self._sent = None

    def update(
        self, slopes_px: Floats, standard_error_px: Floats, covariance_xy_px2: Floats | None = None
    ) -> None:
        """See `Controller`."""
        expected = self.expected().mean_px
        slopes, variance, trust = without_prior(slopes_px, standard_error_px, expected, self.prior_std_px)
        open_loop = slopes - self._interaction @ self._line.acting
        error = np.sqrt(self._noise_factor * variance)
        covariance = None  # of an estimator with a prior, that of the frame alone is not known
        if covariance_xy_px2 is not None and self.prior_std_px is None:
            covariance = self._noise_factor * covariance_xy_px2
        variances = []
        for controller, line in zip(self.controllers, self._lines, strict=True):
            residual = open_loop + self._interaction @ line.acting
            variances.append(float(np.square(self._phase @ (trust * residual)).sum()))
            controller.update(as_estimated(residual, trust, controller), error, covariance)
        self._send()
        self._choose((variances[0] - variances[1]) / max(variances[0] + variances[1], 1e-30))

    def _send(self) -> None:
        """Send the chosen controller's command, with what is left of the offset."""
        command = self._lines[self.chosen].latest
        if self._sent != self.chosen:
            self._sent, self._blended = self.chosen, HANDOVER_FRAMES
            self._offset = self._line.latest - command
        self._blended = max(0, self._blended - 1)
        self._line.put(command + self._blended / HANDOVER_FRAMES * self._offset)

    def _choose(self, difference: float) -> None:
        """Switch from the next frame on if the recent mean difference exceeds its error."""
        self._frames += 1
        share = 1 / min(self._frames, MEMORY_FRAMES)
        self._difference += share * (np.array([difference, difference**2]) - self._difference)
        if self._frames < FEWEST_FRAMES:
            return
        mean, square = self._difference
        values = min(self._frames, 2 * MEMORY_FRAMES) / CORRELATED_FRAMES
        if abs(mean) > STANDARD_ERRORS * np.sqrt(max(0.0, square - mean**2) / values):
            self.chosen = int(mean > 0)
