"""Guarded predictive control of large sensors and of modes: one product is left when slopes arrive."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from faintspot.loop.control.base import CommandDelayLine, ExpectedSlopes, without_prior
from faintspot.loop.control.integrator import LoopPlant, SlopeProduct
from faintspot.loop.control.kalman.guarded import SURPRISE, GuardedController
from faintspot.loop.control.kalman.local_predictor import LocalPredictor
from faintspot.loop.control.kalman.modal_predictor import ModalPredictor
from faintspot.slopes.kernels.products import ProductPart

Floats = NDArray[np.float64]

_LEARNT, _PLAIN = range(2)


class _Frame(NamedTuple):
    """A frame's slopes, and those that commands of both lines cause."""

    open_loop: Floats
    surprise: Floats
    """Open-loop slopes minus their prediction."""
    variance: Floats
    trust: Floats
    by_learnt: Floats
    by_plain: Floats
    by_latest_plain: Floats

    @property
    def residuals(self) -> tuple[Floats, Floats]:
        """Residual slopes that both controllers leave."""
        return self.trust * (self.open_loop + self.by_learnt), self.trust * (self.open_loop + self.by_plain)

    @property
    def missing(self) -> Floats:
        """Addition by the integrator's estimator to what it leaves, where it trusts its prior."""
        return (1 - self.trust) * (self.by_plain - self.by_latest_plain)


class LargeGuarded(GuardedController):
    """Guard of `Predictive` and the integrator, for large sensors and for modes.

    Reading matrices takes most of the time of a frame. They are kept in float32. The predictive command is
    linear in what the slopes differ from their prediction; the matrix of that is computed beforehand, and so
    is the command for slopes as predicted. When slopes arrive, one product is left, which can be begun while
    they are measured. Four more follow with the next frame, or when somebody asks what is expected.

    Parameters
    ----------
    line : CommandDelayLine
        To the mirror.
    plant : LoopPlant
    phase_of_commands : (commands, commands) array
        From commands to the compared amplitudes, see `phase.phase_of_commands`.
    arrays : mapping
        Of the filter, as from `local_filter` or `modal_filter`.
    plain_gain : float
        Of the integrator.
    options
        As for `GuardedController`.
    """

    settle_frames = 0  # a frame has no time for two filters

    def __init__(
        self,
        line: CommandDelayLine,
        plant: LoopPlant,
        phase_of_commands: Floats,
        arrays: Mapping[str, Any],
        plain_gain: float,
        **options: Any,
    ) -> None:
        interaction, reconstructor = plant.interaction, plant.reconstructor
        super().__init__(line, interaction, **options)
        self._predictor = LocalPredictor(arrays) if "around" in arrays else ModalPredictor(arrays)
        self._integrator = plant.integrator(plain_gain, self._lines[_PLAIN])
        self._product, self._reconstruct = SlopeProduct(interaction), SlopeProduct(reconstructor.matrix)
        self._clean, self._compare = SlopeProduct(reconstructor.clean), SlopeProduct(phase_of_commands)
        matrices = self._predictor.replies(line.delay_frames)
        self._replies = [SlopeProduct((matrix.T @ reconstructor.clean.T).T) for matrix in matrices]
        self._caused = np.zeros((2, len(line.rows), len(interaction)))
        """Slopes that the commands of both lines cause, row by row."""
        self._held, self._held_at = np.zeros(len(interaction)), -1
        """Slopes that the mirror adds."""
        self._mean, self._predicted = np.zeros((2, len(interaction)))
        """Predicted slopes of the open loop, and with what the mirror adds."""
        self._level = len(self._replies) // 2
        """Gains of the latest frame."""
        self._if_as_predicted = np.zeros(interaction.shape[1])
        """The predictive command for slopes as predicted."""
        self._frame: _Frame | None = None
        """The previous frame, while it is not complete."""
        self._restarted = True

    def set_plain_gain(self, gain: float) -> None:
        """See `GuardedController`."""
        self._integrator.gain = gain

    def expected(self) -> ExpectedSlopes:
        """See `Controller`."""
        self.complete()
        if self._chosen == _PLAIN:
            return ExpectedSlopes(self._held - self._of_latest(_PLAIN), None)
        return ExpectedSlopes(self._predicted, self._predictor.std_px)

    def begin(self) -> None:
        """See `Controller`; open-loop slopes are assumed to equal the mirror's correction."""
        super().begin()
        self._predictor.begin(-(self._interaction @ self.line.latest))
        self._frame, self._restarted = None, True

    def update(
        self, slopes_px: Floats, standard_error_px: Floats, covariance_xy_px2: Floats | None = None
    ) -> None:
        """See `Controller`; the gains have the usual covariances of x and y."""
        expected = self.expected().mean_px
        errors = self._errors_to_use(slopes_px, standard_error_px)
        slopes, variance, trust = without_prior(slopes_px, errors, expected, self.prior_std_px)
        caused = self._of_acting(_LEARNT), self._of_acting(_PLAIN), self._of_latest(_PLAIN)
        open_loop, surprise = slopes - self._held, slopes - self._predicted
        self._frame = frame = _Frame(open_loop, surprise, self._noise_factor * variance, trust, *caused)
        if self._chosen == _LEARNT:
            self._predict(frame)
        else:
            residual = trust * (slopes - (self._held - frame.by_plain))
            self._integrator.follow(self._reconstruct(residual + frame.missing))
        self._send()

    def begin_product(self, threads: int, scale: float) -> Sequence[ProductPart]:
        """See `Controller`; there are none before a frame is complete, and of estimators with a prior."""
        if self._frame is not None or self._held_at != self.line.next_row or self.prior_std_px is not None:
            return ()
        if self._chosen == _PLAIN:
            return self._reconstruct.parts(threads, scale, self._held - self._of_acting(_PLAIN))
        return self._replies[self._level].parts(threads, scale, self._predicted)

    def _predict(self, frame: _Frame) -> None:
        """Compute the predictive command."""
        surprise, self._level = self._predictor.surprise(frame.surprise, frame.variance)
        self._lines[_LEARNT].put(self._if_as_predicted - self._replies[self._level](surprise))

    def complete(self) -> None:
        """See `Controller`; also compute what does not need the slopes of the next frame."""
        frame, self._frame = self._frame, None
        if frame is not None:
            learnt, plain = self._compare.several(*self._follow_up(frame))
            self._guard[SURPRISE] = self._predictor.failure(frame.surprise, frame.variance)
            self._predictor.correct(frame.open_loop, frame.variance)
            self._predictor.advance()
            if self._choose(float(learnt @ learnt), float(plain @ plain)):
                self._caused[_PLAIN] = self._product.several(*self._lines[_PLAIN].rows)
        if frame is not None or self._restarted or self._held_at != self.line.next_row:
            self._follow_mirror(is_new=frame is not None or self._restarted)

    def _follow_up(self, frame: _Frame) -> Floats:
        """Compute the command that was not sent; return the wavefronts that both leave, as commands."""
        residuals, missing = frame.residuals, frame.missing
        if self._chosen == _PLAIN:
            self._predict(frame)
            return self._reconstruct.several(*residuals)
        if not missing.any():
            wavefronts = self._reconstruct.several(*residuals)
            self._integrator.follow(wavefronts[_PLAIN])
            return wavefronts
        wavefronts = self._reconstruct.several(*residuals, missing)
        self._integrator.follow(wavefronts[_PLAIN] + wavefronts[-1])
        return wavefronts[:-1]

    def _follow_mirror(self, *, is_new: bool) -> None:
        """Compute the slopes that commands cause and, if the latest are new, the prediction."""
        lines, mirror = self._lines, self.line
        commands = [line.latest for line in lines] if is_new else []
        followed = next(
            (k for k, line in enumerate(lines) if np.array_equal(line.acting, mirror.acting)), None
        )
        if followed is None:
            commands.append(mirror.acting)
        new_slopes = self._product.several(*commands) if commands else np.zeros((0, 0))
        if is_new:
            for caused, line, newest in zip(self._caused, lines, new_slopes, strict=False):
                caused[slice(None) if self._restarted else line.next_row - 1] = newest
            self._restarted = False
            self._mean = self._predictor.mean_px
            open_loop = self._predictor.ahead(lines[_LEARNT].delay_frames) + self._of_latest(_LEARNT)
            self._if_as_predicted = lines[_LEARNT].latest - self._clean(open_loop)
        # Those of the mirror's own commands are the last, after those of both lines.
        self._held = new_slopes[-1] if followed is None else self._of_acting(followed)
        self._held_at, self._predicted = mirror.next_row, self._held + self._mean

    def _of_latest(self, line: int) -> Floats:
        """Return the slopes that the latest command of a line causes."""
        slopes: Floats = self._caused[line, self._lines[line].next_row - 1]
        return slopes

    def _of_acting(self, line: int) -> Floats:
        """Return the slopes that the command of a line that acts in this frame causes."""
        rows = self._caused[line]
        slopes: Floats = rows[(self._lines[line].next_row + 1) % len(rows)]
        return slopes
