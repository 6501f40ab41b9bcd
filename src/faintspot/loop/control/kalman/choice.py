"""Choice between a learnt controller and a plain one, from the residuals of both in every frame.

The controller that drives the mirror has its measured residual. That of the other one is computed, and is as
wrong as the model of the loop is. So a filter whose measured residual is above that of the integrator while
it drove the mirror loses the mirror, whatever is computed, and for longer each time.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any

from faintspot.slopes.kernels.compilation.compiling import Direct, compiled_with

MEMORY_FRAMES = 100
CORRELATED_FRAMES = 5  # over which residuals are alike
FEWEST_FRAMES = 50  # before the first change
STANDARD_ERRORS = 1.0  # by which one must leave less than the other
HANDOVER_FRAMES = 10  # after which a controller's own commands are sent
_SETTLING = 15  # frames after a change whose residuals belong to both
_MEASURED, _MEASURED_MEMORY = 20, 200  # frames of the integrator's residual: fewest, and memory
_SHORT, _LONG = 50, 200  # frames over which the filter's residual is averaged
_RUNAWAY, _WORSE, _SLIGHTLY = 16.0, 1.4, 1.1
"""Residuals in those of the integrator that are too large: in one frame, of late, and for long."""
_ASSUMED = 4.0  # residual of an integrator that was computed, by which it may be too small
_FIRST_WAIT, _LONGEST_WAIT = 500, 20_000  # frames that the integrator drives the mirror after that
_PROVEN = 2000  # frames after which the wait is the first one again

# Numbers of the guard: 1 where the plain one's commands go out; the same of the frame before, or another
# number; frames of late, mean difference, its mean square; frames of the handover that are left; frames since
# the last change, and what was chosen before it; measured residuals of the integrator, its frames, and of the
# filter, of late and for long; the integrator's computed residual; frames to wait, now and the next time.
CHOSEN, SENT, FRAMES, _MEAN, _SQUARE, BLENDED, _SINCE, _BEFORE = range(8)
_PLAIN, _PLAIN_FRAMES, _LATE, _FOR_LONG, _COMPUTED, _WAIT, _NEXT_WAIT, _PREFERS = range(8, 16)
GUARD_NUMBERS = 16


@partial(compiled_with, source=__file__)
def choose(guard: Any, learnt: Any, plain: Any) -> None:
    """Select the controller that drives the mirror from the next frame on.

    Parameters
    ----------
    guard : (GUARD_NUMBERS,) array
        From `new_guard`.
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
    guard[_SINCE] += 1.0
    driving = guard[_SINCE] - _SETTLING
    if guard[CHOSEN] > 0.0:
        if driving > 0.0:
            guard[_PLAIN_FRAMES] += 1.0
            guard[_PLAIN] += (plain - guard[_PLAIN]) / min(guard[_PLAIN_FRAMES], _MEASURED_MEMORY)
    else:
        if driving > 0.0:
            guard[_LATE] += (learnt - guard[_LATE]) / min(driving, _SHORT)
            guard[_FOR_LONG] += (learnt - guard[_FOR_LONG]) / min(driving, _LONG)
        usual = guard[_PLAIN] if guard[_PLAIN_FRAMES] >= _MEASURED else _ASSUMED * guard[_COMPUTED]
        worse = driving >= 0.5 * _SHORT and guard[_LATE] > _WORSE * usual
        worse = worse or (driving >= 0.5 * _LONG and guard[_FOR_LONG] > _SLIGHTLY * usual)
        if worse or learnt > _RUNAWAY * usual:
            guard[CHOSEN], guard[_WAIT] = 1.0, guard[_NEXT_WAIT]
            guard[_NEXT_WAIT] = min(2.0 * guard[_NEXT_WAIT], _LONGEST_WAIT)
            guard[FRAMES] = guard[_MEAN] = guard[_SQUARE] = 0.0
            guard[_PREFERS] = 1.0
            return
        if driving > _PROVEN:
            guard[_NEXT_WAIT] = _FIRST_WAIT
    values = min(guard[FRAMES], 2 * MEMORY_FRAMES) / CORRELATED_FRAMES
    error = STANDARD_ERRORS * math.sqrt(max(0.0, guard[_SQUARE] - guard[_MEAN] * guard[_MEAN]) / values)
    if guard[_WAIT] > 0.0:
        guard[_WAIT] -= 1.0
        if guard[_WAIT] == 0.0 and guard[_PREFERS] == 0.0 and guard[_MEAN] <= error:
            guard[CHOSEN] = 0.0
        return
    if guard[FRAMES] >= FEWEST_FRAMES and abs(guard[_MEAN]) > error:
        guard[CHOSEN] = 1.0 if guard[_MEAN] > 0.0 else 0.0


CHOOSE = Direct(choose)


def prepare(guard: Any, prefers_plain: bool, plain_residual: float, plain_frames: int) -> None:
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
    """
    guard[CHOSEN] = guard[SENT] = guard[_BEFORE] = float(prefers_plain or plain_frames > 0)
    guard[_COMPUTED], guard[_PREFERS] = plain_residual, float(prefers_plain)
    guard[_WAIT], guard[_NEXT_WAIT] = plain_frames, _FIRST_WAIT


def restart(guard: Any) -> None:
    """Forget the differences of earlier frames; what was measured of both controllers stays."""
    guard[FRAMES : _SINCE + 1] = 0.0
