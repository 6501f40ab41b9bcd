"""Filters learnt again, from frames of the running loop, and whether they are better."""

import math
from dataclasses import dataclass, replace

from faintspot.base.errors import InputError
from faintspot.loop.control.base import SETTLE_FRAMES, OpenLoopTelemetry
from faintspot.loop.control.beside_the_loop import BLOCK_FRAMES, STANDARD_ERRORS, error_of_mean
from faintspot.loop.control.identification.layers import Identified
from faintspot.loop.control.identification.learning import JUDGED_PART, learn_controller
from faintspot.loop.control.identification.loop_delay import LoopDelay
from faintspot.loop.control.identification.model import Kalman
from faintspot.loop.control.integrator import LoopPlant
from faintspot.loop.slope_covariance import SlopeTurbulence

_FEWEST_BLOCKS = 10
FEWEST_FRAMES = math.ceil(_FEWEST_BLOCKS * BLOCK_FRAMES / JUDGED_PART) + 1
"""Frames of a stretch that can be learnt from and judged on."""


@dataclass(frozen=True, eq=False)
class RelearntControl:
    """New filter, and the residual phase variance that it and others would have left on the same frames.

    All are computed for the centroid gain that was found.
    """

    learnt: Kalman
    residual: float
    by_running: float
    by_integrator: float
    error: float
    """Standard error of `by_running` minus `residual`."""
    delay: LoopDelay | None = None
    """Centroid gain that was found, relative to that of the slopes; None: it was not measured."""
    gain_changed: bool = False
    """Whether it differs from the running filter's beyond its error."""

    @property
    def is_better(self) -> bool:
        """Whether the new filter leaves less than the integrator, and than the running one beyond the error.

        A running filter with another centroid gain would leave more than computed: it is always replaced.
        """
        saved = self.by_running - self.residual
        return (self.gain_changed or saved > STANDARD_ERRORS * self.error) and (
            self.residual < self.by_integrator
        )

    def summary(self) -> str:
        """Return a summary of one line."""
        part, error = self.residual / self.by_running, self.error / self.by_running
        of_integrator = self.residual / self.by_integrator
        gain = "" if self.delay is None else f"{self.delay.gain_summary}, "
        return (
            f"{gain}{self.learnt.description}; phase variance {part:.3f} +- {error:.3f} of the running "
            f"filter's, {of_integrator:.2f} of the integrator's"
        )


def relearn(
    plant: LoopPlant,
    running: Kalman,
    telemetry: OpenLoopTelemetry,
    site: SlopeTurbulence,
    rate_hz: float,
    start: Identified | None = None,
    delay: LoopDelay | None = None,
) -> RelearntControl:
    """Learn from the first part of telemetry, and judge on the rest by replay; nothing else is changed.

    All filters are replayed on the same open-loop slopes, each with its own commands, so that nothing is
    risked on the mirror. The running filter must not have learnt from this telemetry.

    Parameters
    ----------
    plant : Plant
    running : Model
        Model of the Kalman filter in use.
    telemetry : OpenLoopTelemetry
        Consecutive frames.
    site : SlopeTurbulence
    rate_hz : float
        Frames per second.
    start : Identified, optional
        Turbulence that was found before, from which the search starts: faster, but finds no new layer.
    delay : LoopDelay, optional
        With the centroid gain of the telemetry. Default: that of the running filter, not measured again.

    Raises
    ------
    InputError
        When there are too few frames.
    """
    frames = len(telemetry)
    if frames < FEWEST_FRAMES:
        raise InputError(f"telemetry: expected {FEWEST_FRAMES} frames to judge a filter, got {frames}")
    first = frames - round(JUDGED_PART * frames)
    new = learn_controller(plant, telemetry.part(0, first), site, rate_hz, start=start)
    identified, begin = new.identified, max(0, first - SETTLE_FRAMES)
    replayed = telemetry.part(begin, None)  # all have settled when the part begins that they are judged on
    phase = new.phase(plant)
    by_integrator = plant.replayed_integrators([new.plain_gain], replayed, phase)[0]
    residuals = *(model.replayed(plant, replayed, phase) for model in (new, running)), by_integrator
    by_new, by_running, by_integrator = (squares[first - begin :] for squares in residuals)
    gain = running.centroid_gain if delay is None else delay.gain
    changed = delay is not None and abs(gain - running.centroid_gain) > STANDARD_ERRORS * delay.gain_error
    if changed and by_running.mean() < by_new.mean():  # the turbulence known before fits better
        new, by_new = replace(running, plain_gain=new.plain_gain), by_running
    means = float(by_new.mean()), float(by_running.mean()), float(by_integrator.mean())
    # By the residuals the engine chooses what begins.
    learnt = replace(new, left=(means[0], means[2]), centroid_gain=gain, identified=identified)
    error = error_of_mean(by_running - by_new)
    return RelearntControl(learnt, *means, error, delay, changed)
