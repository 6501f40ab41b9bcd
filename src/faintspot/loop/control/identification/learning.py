"""Filters learnt from telemetry, each tried on frames that were kept back."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from faintspot.loop.control.base import ASSUMED, LEARNT, OpenLoopTelemetry
from faintspot.loop.control.flattening import phase_of_commands
from faintspot.loop.control.identification.layers import AVERAGED, Identification, Identified
from faintspot.loop.control.identification.model import Kalman
from faintspot.loop.control.integrator import LoopPlant
from faintspot.loop.slope_covariance import SlopeTurbulence

GAINS = (0.03, 0.05, 0.07, 0.1, 0.13, 0.16, 0.2, 0.25, 0.3, 0.36, 0.43, 0.5, 0.6, 0.7, 0.8)
"""Gains of an integrator that are tried."""
_MOST_REPLAYED, _FEWEST_REPLAYED = 1_200_000, 500  # slopes, and frames, by which controllers are compared
JUDGED_PART = 0.35
"""Part of a stretch, its end, on which models are judged; they are learnt from the rest."""


def learn_controller(
    plant: LoopPlant,
    telemetry: OpenLoopTelemetry,
    site: SlopeTurbulence,
    rate_hz: float,
    winds: str = LEARNT,
    start: Identified | None = None,
    progress: Callable[[int, int], None] | None = None,
    identification: Identification | None = None,
) -> Kalman:
    """Return a Kalman filter learnt from telemetry.

    Parameters
    ----------
    plant : Plant
    telemetry : OpenLoopTelemetry
    site : SlopeTurbulence
        Geometry of the sensor, outer scale and, for winds that are assumed, these.
    rate_hz : float
        Frames per second.
    winds : str
        One of `WINDS`.
    start : Identified, optional
        Earlier turbulence of the same site, from which winds are learnt faster.
    progress : callable, optional
        Called with the steps done and their number while filters of many slopes are computed.
    identification : Identification, optional
        Of this telemetry, with fits that were made before.
    """
    cells = np.rint(site.positions_m[:, ::-1] / site.subaperture_m).astype(np.int64)
    of_commands = phase_of_commands(plant.interaction, cells)
    part = replayed_part(telemetry, len(plant.interaction))
    gain, plain_residual = plant.best_gain(GAINS, part, of_commands @ plant.reconstructor.matrix)
    model = Kalman({}, gain, 1.0, (math.inf, plain_residual), of_commands)
    known = Identification(telemetry, site, rate_hz) if identification is None else identification
    return model.best_of(plant, part, _fits(known.among(AVERAGED[:1]), site, winds, start), progress)


def replayed_part(telemetry: OpenLoopTelemetry, slopes: int) -> OpenLoopTelemetry:
    """Return the frames by which controllers are compared."""
    return telemetry.part(-max(_FEWEST_REPLAYED, _MOST_REPLAYED // slopes), None)


def _fits(
    identification: Identification, site: SlopeTurbulence, winds: str, start: Identified | None
) -> list[Identified]:
    """Return the turbulence with the winds, and from anywhere where that is not ruled out by `start`."""
    earlier = start if start is not None and start.is_layered and winds == LEARNT else None
    if earlier is not None:  # the comparison was made before
        return [identification.layers(earlier)]
    anywhere = identification.anywhere()
    if winds == LEARNT:
        windy = identification.layers(None)
    elif winds == ASSUMED:
        windy = identification.of_winds(site.wind_m_per_s)
    else:
        return [anywhere]
    # A line that the winds explain is no vibration in either model.
    return [windy, replace(anywhere, vibrations=windy.vibrations)]
