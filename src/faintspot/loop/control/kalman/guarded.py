"""Learnt and plain controller on the same slopes, of which the one with less residual drives the mirror."""

import math
from abc import abstractmethod
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.loop.control.base import CommandDelayLine, Controller
from faintspot.loop.control.faults import StuckWatch
from faintspot.slopes.kernels.compiling import Direct, compiled_with

MEMORY_FRAMES = 100
FEWEST_FRAMES = 20  # before the first change
HANDOVER_FRAMES = 10  # after which a controller's own commands are sent
_ENOUGH = 16.0  # sum of the differences, in their standard deviations, for the other one to take over
_LEAST_DEVIATION, _MOST_DEVIATIONS = 0.03, 5.0  # of a difference, and in one frame
_SETTLING = 15  # frames after a change whose residuals belong to both
_MEASURED, _MEASURED_MEMORY = 20, 200  # frames of the integrator's residual: fewest, and memory
_MEASURES = 4
"""Measures of the mirror's controller: residual, surprise, unused slopes, commands at the limit."""
_ALLOWED, MOST_EXCESS, _IN_ONE_FRAME = (1.1, 1.5, 1.3, 1.1), 16.0, (20.0, 5.0, 2.0, 2.0)
"""Measures of the filter in those of the integrator: allowed; sum of the excess; largest that counts."""
_LEAST = 1e-30, 0.5, 1.0, 1.0  # measures of the integrator
_LATE, _RUNAWAY = 10, 2.0
"""Frames, and their mean residual in those of the integrator, with which a filter fails for good."""
_ASSUMED = 4.0  # residual of an integrator that was computed, by which it may be too small
_FIRST_WAIT, _LONGEST_WAIT = 500, 20_000  # frames that the integrator drives the mirror after that
_MANY_COMMANDS = 12  # with which numbers of frames are those above
_PROVEN = 2000  # frames after which the wait is the first one again

# Numbers of the guard: 1 where the plain one's commands go out; the same of the frame before, or another
# number; frames of late, mean difference, its mean square, evidence for the other controller; frames of the
# handover that are left; frames since the last change, and what was chosen before it; frames of the
# integrator that were measured; residual of the filter of late; the integrator's computed residual; frames to
# wait, now and the next time; how many times more frames it needs than with many commands. Then measures of
# this frame, the integrator's means, and sums of the filter's excess.
CHOSEN, SENT, FRAMES, _MEAN, _SQUARE, _EVIDENCE, BLENDED, _SINCE, _BEFORE = range(9)
_PLAIN_FRAMES, _OF_LATE, _COMPUTED, _WAIT, _NEXT_WAIT, _PATIENCE = range(9, 15)
_RESIDUAL, SURPRISE, LEFT_OUT, AT_LIMIT = range(15, 19)
_PLAIN, EXCESS, GUARD_NUMBERS = 19, 23, 27


@partial(compiled_with, source=__file__)
def choose(guard: Any, learnt: object, plain: Any) -> None:
    """Select the controller that drives the mirror from the next frame on.

    Parameters
    ----------
    guard : (GUARD_NUMBERS,) array
        With the measures of this frame but the residual: mean square of surprises in their expected
        deviations, that of slopes that are not used in that of the others, number of commands at the limit.
    learnt, plain : float
        Squared residuals of this frame.
    """
    difference = (learnt - plain) / max(learnt + plain, 1e-30)
    guard[FRAMES] += 1.0
    share = 1.0 / min(guard[FRAMES], MEMORY_FRAMES)
    guard[_MEAN] += share * (difference - guard[_MEAN])
    guard[_SQUARE] += share * (difference * difference - guard[_SQUARE])
    if guard[_BEFORE] != guard[CHOSEN]:
        guard[_BEFORE], guard[_SINCE] = guard[CHOSEN], 0.0
        guard[_EVIDENCE] = guard[_OF_LATE] = 0.0
        for measure in range(_MEASURES):
            guard[EXCESS + measure] = 0.0
    guard[_SINCE] += 1.0
    guard[_RESIDUAL] = plain if guard[CHOSEN] > 0.0 else learnt
    if guard[CHOSEN] > 0.0:
        if guard[_SINCE] > _SETTLING:
            guard[_PLAIN_FRAMES] += 1.0
            for measure in range(_MEASURES):
                change = guard[_RESIDUAL + measure] - guard[_PLAIN + measure]
                memory = _MEASURED_MEMORY * guard[_PATIENCE]
                guard[_PLAIN + measure] += change / min(guard[_PLAIN_FRAMES], memory)
    else:
        is_measured = guard[_PLAIN_FRAMES] >= _MEASURED
        for measure in range(_MEASURES):
            value, usual = guard[_RESIDUAL + measure], guard[_PLAIN + measure]
            if measure == AT_LIMIT - _RESIDUAL:
                value, usual = 1.0 + value, 1.0 + usual
            elif not is_measured:
                computed = guard[_COMPUTED] if measure == 0 else 1.0
                usual = math.inf if measure == LEFT_OUT - _RESIDUAL else _ASSUMED * computed
            ratio = min(value / max(usual, _LEAST[measure]), _IN_ONE_FRAME[measure])
            if measure == 0:
                guard[_OF_LATE] += (ratio - guard[_OF_LATE]) / min(guard[_SINCE], _LATE * guard[_PATIENCE])
            more = (ratio - _ALLOWED[measure]) / guard[_PATIENCE]
            excess = max(0.0, guard[EXCESS + measure] + more)
            guard[EXCESS + measure] = excess
            if excess > MOST_EXCESS:
                guard[EXCESS] = max(guard[EXCESS], excess)
        if guard[EXCESS] > MOST_EXCESS:
            is_runaway = guard[_OF_LATE] > _RUNAWAY
            guard[CHOSEN], guard[_WAIT] = 1.0, _LONGEST_WAIT if is_runaway else guard[_NEXT_WAIT]
            guard[_NEXT_WAIT] = min(2.0 * guard[_NEXT_WAIT], _LONGEST_WAIT)
            guard[FRAMES] = guard[_MEAN] = guard[_SQUARE] = 0.0
            return
        if guard[_SINCE] > _PROVEN:
            guard[_NEXT_WAIT] = _FIRST_WAIT
    if guard[FRAMES] >= FEWEST_FRAMES:
        variance = guard[_SQUARE] - guard[_MEAN] * guard[_MEAN]
        for_plain = difference / max(math.sqrt(max(0.0, variance)), _LEAST_DEVIATION)
        for_other = -for_plain if guard[CHOSEN] > 0.0 else for_plain
        evidence = min(for_other, _MOST_DEVIATIONS) / guard[_PATIENCE]
        guard[_EVIDENCE] = max(0.0, guard[_EVIDENCE] + evidence)
    if guard[_WAIT] > 0.0:
        guard[_WAIT] -= 1.0
    elif guard[_EVIDENCE] > _ENOUGH:
        guard[CHOSEN] = 1.0 - guard[CHOSEN]


CHOOSE = Direct(choose)


def prepare(guard: Any, prefers_plain: bool, plain_residual: float, plain_frames: int, commands: int) -> None:
    """Set the numbers of a guard before its first frame.

    Parameters
    ----------
    guard : (GUARD_NUMBERS,) array
        Zeros.
    prefers_plain : bool
        Whether the plain controller begins, until the other one leaves less.
    plain_residual : float
        Computed residual of the plain controller, as from a replay; infinite if unknown.
    plain_frames : int
        Frames that the plain controller drives the mirror first, so that its residual is measured.
    commands : int
        Number of commands: residuals of few scatter more, so that more frames are needed to judge them.
    """
    guard[_PATIENCE] = patience = max(1.0, _MANY_COMMANDS / commands)
    guard[CHOSEN] = guard[SENT] = guard[_BEFORE] = float(prefers_plain or plain_frames > 0)
    guard[_COMPUTED], guard[_WAIT], guard[_NEXT_WAIT] = plain_residual, plain_frames * patience, _FIRST_WAIT
    if not prefers_plain:  # its recording speaks for it: evidence as with many commands is enough
        guard[_EVIDENCE] = _ENOUGH * (1.0 - 1.0 / patience)


def restart(guard: Any) -> None:
    """Forget the differences of earlier frames; what was measured of the integrator stays."""
    guard[FRAMES : _SINCE + 1] = guard[EXCESS:] = 0.0


Floats = NDArray[np.float64]


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
        See `choice.prepare`.
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
        self._guard, self._offset = np.zeros(GUARD_NUMBERS), np.zeros(interaction.shape[1])
        self._watch = StuckWatch(len(interaction))
        prepare(
            self._guard,
            prefers_plain=prefers_plain,
            plain_residual=plain_residual,
            plain_frames=plain_frames,
            commands=interaction.shape[1],
        )

    @property
    def chosen(self) -> int:
        """0: the learnt controller; 1: the plain one."""
        self.complete()
        return self._chosen

    @property
    def _chosen(self) -> int:
        """The same, while a frame is not complete."""
        return int(self._guard[CHOSEN])

    @abstractmethod
    def set_plain_gain(self, gain: float) -> None:
        """Change the gain of the integrator from the next frame on."""

    def fall_back(self) -> None:
        """See `Controller`."""
        self.complete()
        self._guard[CHOSEN] = 1.0

    def begin(self) -> None:
        """See `Controller`; both restart from there."""
        for line in self._lines:
            line.hold(self.line.latest)
        restart(self._guard)
        self._guard[SENT] = self._guard[CHOSEN]

    def hand_over(self) -> None:
        """See `Controller`."""
        self._guard[SENT] = -1.0

    @property
    def is_stuck(self) -> NDArray[np.bool_]:
        """(n,): sub-apertures whose slopes are not used because they are stuck."""
        return self._watch.is_stuck

    def _errors_to_use(self, slopes_px: Floats, standard_error_px: Floats) -> Floats:
        """Return standard errors, infinite for sub-apertures that are stuck."""
        errors = self._watch(slopes_px, standard_error_px)
        self._guard[LEFT_OUT] = self._watch.left_out
        return errors

    def _choose(self, learnt: float, plain: float) -> bool:
        """Select a controller by the squared residuals; return whether the learnt one has failed.

        The plain one then continues from the mirror's commands: its own are as wrong as the model.
        """
        before = self._chosen
        CHOOSE(self._guard, learnt, plain)
        has_failed = self._chosen > before and bool(self._guard[EXCESS] > MOST_EXCESS)
        if has_failed:
            self._lines[1].copy_from(self.line)
            self._guard[SENT], self._guard[BLENDED] = 1.0, 0.0
        return has_failed

    def _send(self) -> None:
        """Send the chosen controller's command, with what is left of the offset."""
        command, guard = self._lines[self._chosen].latest, self._guard
        if guard[SENT] != guard[CHOSEN]:
            guard[SENT], guard[BLENDED] = guard[CHOSEN], HANDOVER_FRAMES
            self._offset = self.line.latest - command
        guard[BLENDED] = max(0.0, guard[BLENDED] - 1.0)
        self.line.put(command + guard[BLENDED] / HANDOVER_FRAMES * self._offset)
        guard[AT_LIMIT] = np.count_nonzero(np.abs(self.line.latest) >= self.line.largest)
