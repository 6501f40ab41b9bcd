"""From a recording to the loop and the filter of a controller."""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from faintspot.base.arrays import Floats
from faintspot.base.errors import InputError
from faintspot.loop.control.identification.layers import Identification, Identified
from faintspot.loop.control.identification.learning import learn_controller
from faintspot.loop.control.identification.loop_delay import FEWEST_SUBAPERTURES, LoopDelay
from faintspot.loop.control.identification.misregistration import MovableMatrix, misregistration
from faintspot.loop.control.identification.modal_delay import modes_of
from faintspot.loop.control.identification.modal_model import (
    LoopInModes,
    LoopOfControl,
    fit_modal_filter,
    share_of_modes,
)
from faintspot.loop.control.identification.model import Kalman
from faintspot.loop.control.identification.open_loop import (
    OpenLoop,
    measured_delay,
    open_loop_of,
    winds_of,
    with_axes_of,
)
from faintspot.loop.control.identification.preparation import Prepared, prepared
from faintspot.loop.control.identification.recording import Recording
from faintspot.loop.control.integrator import LoopPlant

_MOST_SIGMAS = 5.0  # of the commands that the turbulence asks for
_MOST_OFF = 1.5  # ratio of the recorded gain and the advised one, above which the fallback has the latter
_MARGIN = 0.55  # of the largest stable loop gain, for the largest centroid gain that is likely
_CORRECTIONS = 2  # of the matrix, each followed by learning
_CLEARLY = 0.9  # part of what winds leave, below which modes alone replace them


def control_from_recording(recording: Recording, start: Identified | None) -> tuple[LoopOfControl, Kalman]:
    """Learn the loop and the filter of a controller; see `predictive_control.learn`."""
    if recording.commands is None or recording.interaction_matrix is None:
        absent = "commands" if recording.commands is None else "interaction_matrix"
        raise InputError(f"{absent}: expected an array, got none")
    ready = prepared(recording)
    loop = ready.recording
    if loop.cells is None or len(loop.cells) < FEWEST_SUBAPERTURES:
        measured, used = measured_delay(modes_of(loop).recording)
        return _in_modes(ready, LoopInModes.of(ready, replace(used, delay_error=measured.delay_error)))
    return control_from_observed(_observed(ready), start)


@dataclass(frozen=True, eq=False)
class ObservedLoop:
    """Recording, and what has been measured from it."""

    ready: Prepared
    delay: LoopDelay
    """Delay and centroid gain that are used, with their errors."""
    seen: OpenLoop
    identification: Identification | None = None
    """Identification of its open-loop slopes, if made already."""
    recorded_interaction: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    """Interaction matrix of `ready` before it was corrected; or empty."""


def control_with_new_winds(recording: Recording, like: LoopOfControl) -> tuple[LoopOfControl, Kalman]:
    """Learn the winds, and the centroid gain, of a loop whose delay, mirror and axes are known.

    Raises
    ------
    InputError
        As `control_from_recording`.
    """
    ready = prepared(recording)
    _, used = measured_delay(ready.recording)
    n = len(like.scale) // 2
    delay = replace(used, x_to_y=float(like.scale[n] / like.scale[0]))
    observed = ObservedLoop(ready, delay, open_loop_of(ready.recording, delay))
    described, learnt = _with_winds(observed, None)
    return _controlling(_with_found_winds(described, learnt), ready, observed.seen, learnt)


def control_from_observed(
    observed: ObservedLoop, start: Identified | None = None
) -> tuple[LoopOfControl, Kalman]:
    """Learn as `learn` from a recording whose delay and open-loop slopes are known."""
    (described, learnt), recorded = _with_winds(observed, start), observed
    if not learnt.is_local:
        observed, described, learnt = _corrected(observed, described, learnt, start)
    ready, seen, modes = observed.ready, observed.seen, LoopInModes.of(observed.ready, observed.delay)
    if not learnt.is_local:
        share = share_of_modes(modes, learnt, described.plant(), seen)
        if share < _CLEARLY:
            return _in_modes(ready, modes)
        description = f"{learnt.description}, modes alone leave {share:.2f} of what winds leave"
        learnt = replace(learnt, description=description)
    is_proven = observed is recorded
    ran = modes if is_proven else LoopInModes.of(recorded.ready, recorded.delay)
    described = replace(_with_found_winds(described, learnt), law=ran.described.law)
    return _controlling(described, ready, seen, learnt, is_proven=is_proven)


def _with_found_winds(described: LoopOfControl, learnt: Kalman) -> LoopOfControl:
    """Return the loop with the winds of its filter."""
    identified = learnt.identified
    if identified is None or not identified.is_layered:
        return described
    return replace(described, winds=np.array([wind.row() for wind in winds_of(identified)]))


def _observed(ready: Prepared) -> ObservedLoop:
    """Measure delay, centroid gain and open-loop slopes.

    Raises
    ------
    InputError
        When they cannot be measured.
    """
    loop = ready.recording
    measured, used = measured_delay(loop)
    delay = with_axes_of(loop, replace(used, delay_error=measured.delay_error))
    return ObservedLoop(ready, delay, open_loop_of(loop, delay))


def _with_winds(observed: ObservedLoop, start: Identified | None) -> tuple[LoopOfControl, Kalman]:
    """Learn the filter of winds, for the interaction matrix as given."""
    ready, delay, seen = observed.ready, observed.delay, observed.seen
    loop, error = ready.recording, np.sqrt(seen.variance)
    described = LoopOfControl.of(
        ready,
        delay,
        loop.interaction_matrix,
        error,
        delay.gains(len(loop.cells)),
        recorded_interaction=observed.recorded_interaction,
    )
    learnt = learn_controller(
        described.plant(),
        seen.telemetry,
        loop.site,
        loop.frame_rate_hz,
        start=start,
        identification=observed.identification,
    )
    return described, learnt


def _corrected(
    observed: ObservedLoop, described: LoopOfControl, learnt: Kalman, start: Identified | None
) -> tuple[ObservedLoop, LoopOfControl, Kalman]:
    """Learn again with a corrected matrix, as long as the mirror has changed since it was measured."""
    loop = observed.ready.recording
    matrix = MovableMatrix(loop.cells, loop.interaction_matrix)
    for _ in range(_CORRECTIONS):
        found = misregistration(loop, observed.delay, matrix, learnt.slope_predictor)
        if not found.is_wrong:
            break
        remarks = (*loop.remarks, *found.remarks())
        mended = replace(loop, interaction_matrix=found.corrected(matrix), remarks=remarks)
        try:
            again = _observed(observed.ready._replace(recording=mended))
        except InputError:  # the gain cannot be measured with that matrix
            break
        observed = replace(again, recorded_interaction=loop.interaction_matrix)
        described, learnt = _with_winds(observed, start)
    return observed, described, learnt


def _in_modes(ready: Prepared, modes: LoopInModes) -> tuple[LoopOfControl, Kalman]:
    """Learn from modes alone."""
    learnt = fit_modal_filter(modes)
    return _controlling(modes.described, ready, modes.seen, learnt)


def _controlling(
    described: LoopOfControl, ready: Prepared, seen: OpenLoop, learnt: Kalman, *, is_proven: bool = True
) -> tuple[LoopOfControl, Kalman]:
    """Return the control of a learnt filter, with its fallback and stroke limit.

    The fallback's gain is raised only with the matrix with which the loop has run (`is_proven`).
    """
    loop, plant, gain = ready.recording, described.plant(), float(described.delay[2])
    advised = _advised_gain(learnt.plain_gain, gain, float(described.delay[3]), plant.delay_frames)
    if described.analysis.size or not is_proven:  # a loop that has run is stable
        advised = min(advised, ready.loop_gain)
    recorded, remarks = ready.loop_gain, list(loop.remarks)
    plain = recorded if math.isfinite(recorded) else advised
    is_off = abs(math.log(max(plain, 1e-9) / advised)) > math.log(_MOST_OFF)
    has_sure_gain = not described.analysis.size  # of modes it is less certain than that the loop has run
    if is_off and has_sure_gain:
        plain = advised
        described = replace(described, recorded_gain=max(recorded, 1e-9) * gain)
        remarks.append(f"fallback integrator: gain {advised:.2g}, as the recorded {recorded:.2g} leaves more")
    described = replace(
        described, largest_command=_largest_command(ready, seen, plant), integrator_gain=advised
    )
    description = "; ".join([learnt.description, *remarks])
    return described, replace(learnt, plain_gain=plain * gain, description=description)


def _advised_gain(best: float, gain: float, gain_error: float, delay_frames: int) -> float:
    """Return the loop gain on slopes as measured: the best by replay, or less, as it must be stable.

    Parameters
    ----------
    best : float
        Of slopes divided by the centroid gain.
    gain, gain_error : float
        Centroid gain.
    delay_frames : int
        Whole frames; an integrator is stable up to 2 sin(pi / (4 delay - 2)).
    """
    most = _MARGIN * 2 * math.sin(math.pi / (4 * delay_frames - 2))
    return min(best / gain, most / (gain + (gain_error if math.isfinite(gain_error) else 0.0)))


def _largest_command(ready: Prepared, seen: OpenLoop, plant: LoopPlant) -> Floats:
    """Return stroke limits: what the loop's leaves, or 5 sigma of what the recorded wavefront asks for."""
    loop, flat = ready.recording, ready.flat_command
    asked = seen.telemetry.open_loop_px @ plant.reconstructor.matrix.T
    static = np.abs(loop.commands.mean(axis=0)) * loop.interaction_matrix.any(axis=0)
    limit = np.full(len(static), float((static + _MOST_SIGMAS * asked.std(axis=0)).max()))
    if loop.largest_command is not None:
        limit = np.minimum(limit, np.maximum(loop.largest_command - np.abs(flat), 0.0))
    return limit
