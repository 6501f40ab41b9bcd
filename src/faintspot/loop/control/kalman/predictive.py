"""Control from open-loop slopes: pseudo-open-loop control and predictive control."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from faintspot.loop.control.base import Controller, ExpectedSlopes, Predictor
from faintspot.loop.control.commands import CommandDelayLine
from faintspot.loop.control.kalman.predictor import LARGEST_VARIANCE_PX2
from faintspot.loop.control.noise import add_noise

Floats = NDArray[np.float64]


class PseudoOpenLoop(Controller):
    """Pseudo-open-loop control: maximum a posteriori wavefront from open-loop slopes.

    Gilles 2005, Appl. Opt. 44, 993. Slopes count by their noise in each frame, x and y by their
    covariance. As a gain g averages over frames, the reconstructor is that for their noise in the mean,
    g / (2 - g) of a frame's.

    Parameters
    ----------
    line : CommandDelayLine
    interaction : (m, commands) array
    now_px2 : (m, m) array
        Covariance of open-loop slopes.
    ahead_px2 : (m, m) array
        E[later slopes, slopes now]: those of the frame in which the command acts; or `now_px2`.
    reconstruct : (commands, m) array
        The wavefront, as commands that cause it, from open-loop slopes without noise.
    gain : float
        How much of the way to the new wavefront a command goes, 0 to 1.
    """

    undoes_prior = True

    def __init__(
        self,
        line: CommandDelayLine,
        interaction: Floats,
        now_px2: Floats,
        ahead_px2: Floats,
        reconstruct: Floats,
        gain: float,
    ) -> None:
        super().__init__(line, interaction)
        self._gain, self._now, self._ahead = gain, now_px2, reconstruct @ ahead_px2

    def update(
        self, slopes_px: Floats, standard_error_px: Floats, covariance_xy_px2: Floats | None = None
    ) -> None:
        """See `Controller`."""
        line, gain = self.line, self._gain
        variance = np.minimum(np.square(standard_error_px), LARGEST_VARIANCE_PX2)
        noisy = self._now.copy()
        share = gain / (2 - gain)
        add_noise(noisy, share * variance, None if covariance_xy_px2 is None else share * covariance_xy_px2)
        wavefront = self._ahead @ np.linalg.solve(noisy, slopes_px - self._interaction @ line.acting)
        line.put((1 - gain) * line.latest - gain * wavefront)


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
