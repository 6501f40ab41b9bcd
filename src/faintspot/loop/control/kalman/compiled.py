"""Controller with the compiled Kalman filter and its fallback."""

from typing import Any

import numpy as np

from faintspot.base.arrays import Floats
from faintspot.loop.control.base import (
    LEAST_VARIANCE_PX2,
    CommandDelayLine,
    Controller,
    ExpectedSlopes,
    OpenLoopTelemetry,
    Predictor,
)
from faintspot.loop.control.integrator import LoopPlant
from faintspot.loop.control.kalman.guarded import GuardedController
from faintspot.loop.control.kalman.kernels import (
    COMMAND_ROWS,
    FOLLOW,
    GO_ON,
    HELD,
    HOLD,
    LATEST_PLAIN,
    PREDICTED,
    SLOPE_ROWS,
    Frame,
    Lines,
    Matrices,
    Memory,
    replay,
)
from faintspot.loop.control.kalman.predictor import SlopePredictor, shares

STEPS = 4
"""Conjugate-gradient iterations used to compute the Kalman gain."""
_NO_PRIOR = np.zeros(0)


class CompiledKalman(GuardedController):
    """Guard of `Predictive` and the integrator, in compiled code.

    How much each slope corrects follows the noise of each frame, as in `SlopePredictor`; in place of solving
    its equations to the end it takes `STEPS` steps of conjugate gradients, which is products with matrices.

    Before a command goes out, only that is done which needs the frame's slopes: the rest when somebody asks
    what is expected next, or with the next `update`.

    Parameters
    ----------
    line : CommandDelayLine
        To the mirror.
    plant : LoopPlant
    phase : (commands, m) array
        From slopes to what is compared, see `residual_phase`.
    predictor : SlopePredictor
    plain_gain : float
        Of the integrator.
    steps : int
        Of conjugate gradients.
    options
        As for `GuardedController`.
    """

    def __init__(
        self,
        line: CommandDelayLine,
        plant: LoopPlant,
        phase: Floats,
        predictor: SlopePredictor,
        plain_gain: float,
        *,
        steps: int = STEPS,
        **options: Any,
    ) -> None:
        super().__init__(line, plant.interaction, **options)
        slopes, commands = plant.interaction.shape
        ahead = -plant.reconstructor.clean @ predictor.model.ahead(line.delay_frames)
        usual = predictor.usual_px2
        self._matrices = Matrices(
            np.ascontiguousarray(plant.interaction.T),
            np.ascontiguousarray(plant.reconstructor.matrix.T),
            np.ascontiguousarray(phase.T),
            np.ascontiguousarray(predictor.with_slopes.T),
            predictor.predicted_px2,
            np.linalg.inv(usual),
            np.diag(usual).copy(),
            np.ascontiguousarray(predictor.model.both.swapaxes(1, 2)),
            np.ascontiguousarray(ahead.T),
        )
        self._rows = Lines(line.rows, *(own_line.rows for own_line in self._lines))
        self._memory = Memory(
            np.zeros((predictor.model.layers, 2, slopes)),
            self._guard,
            np.zeros((SLOPE_ROWS, slopes)),
            np.zeros((COMMAND_ROWS, commands)),
        )
        self._numbers = float(plain_gain), 1.0 - plant.leak, line.largest, steps
        self._std_px, self._shares = predictor.std_px, shares(predictor.model)
        self._independent = np.zeros(slopes // 2)
        self._is_behind = False
        self._held_at = -1
        """Position of the delay line at which the acting command was turned into slopes."""

    def set_plain_gain(self, gain: float) -> None:
        """See `GuardedController`."""
        self._numbers = gain, *self._numbers[1:]

    def expected(self) -> ExpectedSlopes:
        """See `Controller`."""
        self.complete()
        rows = self._memory.slopes
        if self._chosen:
            return ExpectedSlopes(rows[HELD] - rows[LATEST_PLAIN], None)
        return ExpectedSlopes(rows[HELD] + rows[PREDICTED], self._std_px)

    def begin(self) -> None:
        """See `Controller`; open-loop slopes are assumed to equal the mirror's correction."""
        super().begin()
        open_loop = -(self._interaction @ self.line.latest)
        self._memory.state[:] = self._shares[:, None, None] * open_loop
        self._memory.slopes[PREDICTED] = open_loop
        self._is_behind, self._held_at = False, -1

    def update(
        self, slopes_px: Floats, standard_error_px: Floats, covariance_xy_px2: Floats | None = None
    ) -> None:
        """See `Controller`; of an estimator with a prior, x and y are taken to be independent.

        Raises
        ------
        ArithmeticError
            When a controller's commands are not finite.
        """
        self.complete()
        prior = self.prior_std_px
        frame = Frame(
            slopes_px,
            self._errors_to_use(slopes_px, standard_error_px),
            self._independent if covariance_xy_px2 is None else covariance_xy_px2,
            _NO_PRIOR if prior is None else prior,
            self._noise_factor,
        )
        total = FOLLOW(frame, self._numbers, self._matrices, self._rows, self._next_rows(), self._memory)
        self.line.sent(total)
        self._is_behind = True

    def replayed(self, telemetry: OpenLoopTelemetry) -> Floats:
        """Return the squared residual that the filter alone would have left, (frames,).

        See `replayed_frames`. Turbulence and mirror, of unlimited stroke, begin flat. The state is lost.
        """
        squares = np.zeros(len(telemetry))
        variance = np.maximum(self._noise_factor * telemetry.variance_px2, LEAST_VARIANCE_PX2)
        covariance = self._noise_factor * telemetry.covariances_px2
        self._memory.state[:], self._memory.slopes[PREDICTED] = 0.0, 0.0
        line = np.zeros_like(self._rows.learnt)
        recorded = telemetry.open_loop_px, variance, covariance, telemetry.trust
        gain, keep, largest, steps = self._numbers
        numbers = gain, keep, np.full_like(largest, np.inf), steps
        replay(recorded, numbers, self._matrices, line, self._memory, squares)
        return squares

    def complete(self) -> None:
        """See `Controller`."""
        if self._is_behind:
            self._is_behind, self._held_at = False, -1
            total = GO_ON(self._numbers, self._matrices, self._rows, self._next_rows(), self._memory)
            for line in self._lines:
                line.sent(total)
        if self._held_at != self.line.next_row:
            HOLD(self._matrices, self._rows, self._next_rows(), self._memory)
            self._held_at = self.line.next_row

    def _next_rows(self) -> tuple[int, int, int]:
        learnt, plain = self._lines
        return self.line.next_row, learnt.next_row, plain.next_row


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
