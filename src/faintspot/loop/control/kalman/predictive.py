"""Predictive control from open-loop slopes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from faintspot.loop.control.base import CommandDelayLine, Controller, ExpectedSlopes, Predictor

Floats = NDArray[np.float64]


class Predictive(Controller):
    """Predictive control: commands from the Kalman filter's prediction for the frame in which they act.

    Parameters
    ----------
    line : CommandDelayLine
    interaction : (m, commands) array
    predictor : Predictor
    reconstruct : (commands, m) array
        The wavefront, as commands that cause it, from open-loop slopes without noise.
    from_latest : bool
        Whether the command is the latest one, corrected for what it leaves of the prediction. What a
        regularised reconstructor leaves then vanishes over frames: of 40 x 40 sub-apertures 14 % of focus.
    """

    undoes_prior = True

    def __init__(
        self,
        line: CommandDelayLine,
        interaction: Floats,
        predictor: Predictor,
        reconstruct: Floats,
        *,
        from_latest: bool = False,
    ) -> None:
        super().__init__(line, interaction)
        self.predictor, self._reconstruct, self._from_latest = predictor, reconstruct, from_latest

    def expected(self) -> ExpectedSlopes:
        """See `Controller`."""
        mean = self.predictor.mean_px + self._interaction @ self.line.acting
        return ExpectedSlopes(mean, self.predictor.std_px)

    def begin(self) -> None:
        """See `Controller`; open-loop slopes are assumed to equal the mirror's correction."""
        self.predictor.begin(-(self._interaction @ self.line.latest))

    def update(
        self, slopes_px: Floats, standard_error_px: Floats, covariance_xy_px2: Floats | None = None
    ) -> None:
        """See `Controller`."""
        open_loop = slopes_px - self._interaction @ self.line.acting
        self.predictor.correct(open_loop, np.square(standard_error_px), covariance_xy_px2)
        start = self.line.latest if self._from_latest else np.zeros_like(self.line.latest)
        open_loop_ = self.predictor.ahead(self.line.delay_frames) + self._interaction @ start
        self.line.put(start - self._reconstruct @ open_loop_)
        self.predictor.advance()
