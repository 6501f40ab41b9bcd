"""Rule that selects, frame by frame, the controller that drives the mirror: the filter or the integrator."""

import math
from functools import partial
from typing import Any

import numpy as np

from faintspot.slopes.kernels.compiling import Direct, compiled_with

FILTER, INTEGRATOR, OTHER = 0, 1, -1
HANDOVER_FRAMES = 10
"""Frames after which a controller's own commands are sent."""
RESIDUAL, SURPRISE, LEFT_OUT, AT_LIMIT = range(4)
"""Measures of the controller that drives the mirror: squared residual; mean square of surprises in their
expected deviations; that of slopes that are not used in that of the others; commands at the limit."""
_MEASURES = 4
_ALLOWED, MOST_EXCESS, _IN_ONE_FRAME = (1.1, 1.5, 1.3, 1.1), 16.0, (20.0, 5.0, 2.0, 2.0)
"""Measures of the filter relative to the integrator's: allowed; sum of the excess; largest that counts."""
_LEAST = 1e-30, 0.5, 1.0, 1.0  # measures of the integrator
_LATE, _RUNAWAY = 10, 2.0
"""Frames, and their mean residual relative to the integrator's, with which a filter fails for good."""
_ASSUMED = 4.0  # factor by which a computed residual of the integrator may be too small
_MEMORY, _FEWEST = 100, 20  # frames of the difference's mean, and before the first change
_ENOUGH = 16.0  # sum of the differences, in standard deviations, with which the other controller takes over
_LEAST_DEVIATION, _MOST_DEVIATIONS = 0.03, 5.0  # of a difference, and in one frame
_SETTLING = 15  # frames after a change whose residuals belong to both
_MEASURED, _MEASURED_MEMORY = 20, 200  # frames of the integrator's measures: fewest, and memory
_FIRST_WAIT, _LONGEST_WAIT = 500, 20_000  # frames that the integrator drives the mirror after a failure
_MANY_COMMANDS = 12  # with which the numbers of frames above are right
_PROVEN = 2000  # frames after which the wait is the first one again

GUARD = np.dtype(
    [
        ("chosen", np.int64),  # controller of the next frame
        ("sent", np.int64),  # controller whose command was sent last
        ("before", np.int64),  # `chosen` of the frame before
        ("since", np.int64),  # frames since it changed
        ("blended", np.int64),  # frames of the handover that are left
        ("compared", np.int64),  # frames whose difference is in the means
        ("mean", np.float64),  # of the difference of the residuals
        ("square", np.float64),  # mean square of the difference
        ("evidence", np.float64),  # for the other controller
        ("integrator_frames", np.int64),  # frames of the integrator that were measured
        ("recent_residual", np.float64),  # of the filter, relative to the integrator's
        ("computed_residual", np.float64),  # of the integrator
        ("wait", np.float64),  # frames before the other controller may take over
        ("next_wait", np.float64),
        ("patience", np.float64),  # factor on numbers of frames: few commands scatter more
        ("measures", np.float64, (_MEASURES,)),  # of this frame
        ("usual", np.float64, (_MEASURES,)),  # means of the integrator's measures
        ("excess", np.float64, (_MEASURES,)),  # sums of the filter's excess over them
    ]
)
"""What the rule remembers between frames."""

_compiled = partial(compiled_with, source=__file__)


def new_guard(prefers_plain: bool, plain_residual: float, plain_frames: int, commands: int) -> Any:
    """Return the guard before its first frame.

    Parameters
    ----------
    prefers_plain : bool
        Whether the integrator begins, until the filter leaves less.
    plain_residual : float
        Computed squared residual of the integrator, as from a replay; infinite if unknown.
    plain_frames : int
        Frames that the integrator drives the mirror first, so that its residual is measured.
    commands : int
        Number of commands: residuals of few scatter more, so that more frames are needed to judge them.

    Returns
    -------
    () array of `GUARD`
    """
    guard = np.zeros((), GUARD)
    guard["patience"] = patience = max(1.0, _MANY_COMMANDS / commands)
    guard["chosen"] = guard["sent"] = guard["before"] = prefers_plain or plain_frames > 0
    guard["computed_residual"] = plain_residual
    guard["wait"], guard["next_wait"] = plain_frames * patience, _FIRST_WAIT
    if not prefers_plain:  # its recording speaks for the filter: evidence as with many commands is enough
        guard["evidence"] = _ENOUGH * (1.0 - 1.0 / patience)
    return guard


def restart(guard: Any) -> None:
    """Forget the differences of earlier frames; what was measured of the integrator stays."""
    for name in ("compared", "mean", "square", "evidence", "blended", "since", "excess"):
        guard[name] = 0


@_compiled
def choose(guard: Any, learnt: Any, plain: Any) -> None:
    """Select the controller that drives the mirror from the next frame on.

    Parameters
    ----------
    guard : () array of `GUARD`
        With the measures of this frame but the residual.
    learnt, plain : float
        Squared residuals of this frame.
    """
    state = guard[()]
    difference = (learnt - plain) / max(learnt + plain, 1e-30)
    _compare(state, difference)
    _notice_change(state)
    if state.chosen == INTEGRATOR:
        state.measures[RESIDUAL] = plain
        _measure_integrator(state)
    else:
        state.measures[RESIDUAL] = learnt
        _sum_excess(state)
        if state.excess[RESIDUAL] > MOST_EXCESS:
            _replace_filter(state)
            return
        if state.since > _PROVEN:
            state.next_wait = _FIRST_WAIT
    _weigh(state, difference)
    if state.wait > 0.0:
        state.wait -= 1.0
    elif state.evidence > _ENOUGH:
        state.chosen = FILTER if state.chosen == INTEGRATOR else INTEGRATOR


@_compiled
def _compare(state: Any, difference: Any) -> None:
    """Update the means of the difference and of its square."""
    state.compared += 1
    share = 1.0 / min(state.compared, _MEMORY)
    state.mean += share * (difference - state.mean)
    state.square += share * (difference * difference - state.square)


@_compiled
def _notice_change(state: Any) -> None:
    """Count the frames of the controller that drives the mirror; a new one begins without evidence."""
    if state.before != state.chosen:
        state.before, state.since = state.chosen, 0
        state.evidence = state.recent_residual = 0.0
        for measure in range(_MEASURES):
            state.excess[measure] = 0.0
    state.since += 1


@_compiled
def _measure_integrator(state: Any) -> None:
    """Update the means of the integrator's measures."""
    if state.since > _SETTLING:
        state.integrator_frames += 1
        frames = min(state.integrator_frames, _MEASURED_MEMORY * state.patience)
        for measure in range(_MEASURES):
            state.usual[measure] += (state.measures[measure] - state.usual[measure]) / frames


@_compiled
def _ratio(state: Any, measure: Any) -> Any:
    """Return a measure of the filter relative to the integrator's."""
    value, usual = state.measures[measure], state.usual[measure]
    if measure == AT_LIMIT:
        value, usual = 1.0 + value, 1.0 + usual
    elif state.integrator_frames < _MEASURED:
        usual = _ASSUMED * state.computed_residual if measure == RESIDUAL else _ASSUMED
        if measure == LEFT_OUT:
            usual = math.inf
    return min(value / max(usual, _LEAST[measure]), _IN_ONE_FRAME[measure])


@_compiled
def _sum_excess(state: Any) -> None:
    """Sum what the filter's measures exceed; a sum that is too large becomes that of the residual as well."""
    for measure in range(_MEASURES):
        ratio = _ratio(state, measure)
        if measure == RESIDUAL:
            frames = min(state.since, _LATE * state.patience)
            state.recent_residual += (ratio - state.recent_residual) / frames
        excess = max(0.0, state.excess[measure] + (ratio - _ALLOWED[measure]) / state.patience)
        state.excess[measure] = excess
        if excess > MOST_EXCESS:
            state.excess[RESIDUAL] = max(state.excess[RESIDUAL], excess)


@_compiled
def _replace_filter(state: Any) -> None:
    """Let the integrator drive the mirror for twice as long as the last time, or the longest time."""
    state.chosen = INTEGRATOR
    state.wait = _LONGEST_WAIT if state.recent_residual > _RUNAWAY else state.next_wait
    state.next_wait = min(2.0 * state.next_wait, _LONGEST_WAIT)
    state.compared, state.mean, state.square = 0, 0.0, 0.0


@_compiled
def _weigh(state: Any, difference: Any) -> None:
    """Add the difference, in its standard deviation, to the evidence for the other controller."""
    if state.compared >= _FEWEST:
        variance = state.square - state.mean * state.mean
        for_integrator = difference / max(math.sqrt(max(0.0, variance)), _LEAST_DEVIATION)
        for_other = -for_integrator if state.chosen == INTEGRATOR else for_integrator
        evidence = min(for_other, _MOST_DEVIATIONS) / state.patience
        state.evidence = max(0.0, state.evidence + evidence)


CHOOSE = Direct(choose)
