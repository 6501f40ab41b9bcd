"""Slow, obvious form of the guarded filter, which compiled ones must equal."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.loop.control.base import (
    CommandDelayLine,
    Controller,
    ExpectedSlopes,
    as_estimated,
    without_prior,
)
from faintspot.loop.control.kalman.guard import SURPRISE
from faintspot.loop.control.kalman.guarded import GuardedController
from faintspot.loop.control.kalman.predictor import LARGEST_VARIANCE_PX2

Floats = NDArray[np.float64]


class Guarded(GuardedController):
    """Any two controllers side by side.

    Parameters
    ----------
    line : CommandDelayLine
    interaction : (m, commands) array
    phase : (k, m) array
        From slopes to what is compared, see `residual_phase`.
    learnt, plain : callable
        Return a controller, given where its commands go.
    options
        As for `GuardedController`.
    """

    def __init__(
        self,
        line: CommandDelayLine,
        interaction: Floats,
        phase: Floats,
        learnt: Callable[[CommandDelayLine], Controller],
        plain: Callable[[CommandDelayLine], Controller],
        **options: Any,
    ) -> None:
        super().__init__(line, interaction, **options)
        self._phase, makers = phase, (learnt, plain)
        self._controllers = [make(own_line) for make, own_line in zip(makers, self._lines, strict=True)]

    def set_plain_gain(self, gain: float) -> None:
        """See `GuardedController`."""
        self._controllers[1].gain = gain

    def expected(self) -> ExpectedSlopes:
        """See `Controller`."""
        mean, std = self._controllers[self.chosen].expected()
        offset = self.line.acting - self._lines[self.chosen].acting
        return ExpectedSlopes(mean + self._interaction @ offset, std)

    def begin(self) -> None:
        """See `Controller`."""
        super().begin()
        for controller in self._controllers:
            controller.begin()

    def update(
        self, slopes_px: Floats, standard_error_px: Floats, covariance_xy_px2: Floats | None = None
    ) -> None:
        """See `Controller`."""
        expected = self.expected().mean_px
        errors = self._errors_to_use(slopes_px, standard_error_px)
        slopes, variance, trust = without_prior(slopes_px, errors, expected, self.prior_std_px)
        open_loop = slopes - self._interaction @ self.line.acting
        error = np.sqrt(self._noise_factor * variance)
        covariance = None  # of an estimator with a prior, that of the frame alone is not known
        if covariance_xy_px2 is not None and self.prior_std_px is None:
            covariance = self._noise_factor * covariance_xy_px2
        learnt = self._controllers[0].expected()
        if learnt.std_px is not None:
            surprise = open_loop + self._interaction @ self._lines[0].acting - learnt.mean_px
            in_deviations = np.square(surprise) / (np.square(learnt.std_px) + np.square(error))
            measured = np.square(error) < LARGEST_VARIANCE_PX2
            self._guard["measures"][SURPRISE] = in_deviations[measured].sum() / max(
                1, np.count_nonzero(measured)
            )
        variances = []
        for controller, line in zip(self._controllers, self._lines, strict=True):
            residual = open_loop + self._interaction @ line.acting
            variances.append(float(np.square(self._phase @ (trust * residual)).sum()))
            controller.update(as_estimated(residual, trust, controller), error, covariance)
        self._send()
        self._choose(*variances)
