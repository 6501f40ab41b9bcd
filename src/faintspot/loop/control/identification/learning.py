"""Controllers that learn what they need to know from telemetry, with an integrator to fall back to."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from faintspot.loop.control.base import ASSUMED, LEARNT
from faintspot.loop.control.identification.layers import AVERAGED, Identification, Identified
from faintspot.loop.control.identification.model import (
    CONTROLS,
    INTEGRATOR,
    KALMAN,
    MODAL,
    POLC,
    ControlModel,
    LoopPlant,
)
from faintspot.loop.control.kalman.local_covariance import STEPS
from faintspot.loop.control.kalman.local_predictor import local_filter
from faintspot.loop.control.modal_gains import largest_stable_gain, modal_gains
from faintspot.loop.control.phase import phase_of_commands
from faintspot.loop.control.telemetry import OpenLoopTelemetry, usual_noise
from faintspot.loop.turbulence.slope_covariance import SlopeTurbulence

__all__ = [
    "CONTROLS",
    "INTEGRATOR",
    "KALMAN",
    "MODAL",
    "POLC",
    "LoopPlant",
    "learn_controller",
]

Floats = NDArray[np.float64]
Advance = Callable[[], None]


GAINS = (0.03, 0.05, 0.07, 0.1, 0.13, 0.16, 0.2, 0.25, 0.3, 0.36, 0.43, 0.5, 0.6, 0.7, 0.8)
"""Gains of an integrator that are tried."""
_POLC_GAINS = (0.05, 0.1, 0.2, 0.3, 0.45, 0.65)
_MOST_SLOPES = 300  # whose filter lets each correct all others
_MOST_REPLAYED, _FEWEST_REPLAYED = 1_200_000, 500  # slopes, and frames, by which controllers are compared
_LARGEST_PART = 0.85  # of the gain at which a mode would be unstable where slopes are fully trusted


def learn_controller(
    kind: str,
    plant: LoopPlant,
    telemetry: OpenLoopTelemetry,
    site: SlopeTurbulence,
    rate_hz: float,
    winds: str = LEARNT,
    noise_scale: float = 1.0,
    start: Identified | None = None,
    progress: Callable[[int, int], None] | None = None,
    identification: Identification | None = None,
) -> ControlModel:
    """Return the model of a controller of the given kind, learnt from telemetry.

    Parameters
    ----------
    kind : str
        One of `CONTROLS` but the plain integrator.
    plant : Plant
    telemetry : OpenLoopTelemetry
    site : SlopeTurbulence
        Geometry of the sensor, outer scale and, for winds that are assumed, these.
    rate_hz : float
        Frames per second.
    winds : str
        One of `WINDS`.
    noise_scale : float
        Factor on the noise variance that telemetry shows.
    start : Identified, optional
        Earlier turbulence of the same site, from which winds are learnt faster.
    progress : callable, optional
        Called with the steps done and their number while filters of many slopes are computed.
    identification : Identification, optional
        Of this telemetry, with fits that were made before.
    """
    cells = np.rint(site.positions_m[:, ::-1] / site.subaperture_m).astype(np.int64)
    of_commands = phase_of_commands(plant.interaction, cells)
    frames = max(_FEWEST_REPLAYED, _MOST_REPLAYED // len(site.positions_m) // 2)
    whole, telemetry = telemetry, telemetry.part(-frames, None)
    gain, plain_residual = plant.best_gain(GAINS, telemetry, of_commands @ plant.reconstructor.matrix)
    plain = ControlModel(kind, {}, gain, 1.0, (math.inf, plain_residual), of_commands)
    if kind == MODAL:
        return _modal(plain, plant, telemetry)
    if identification is None:
        identification = Identification(whole, site, rate_hz)
    identification = identification.among(AVERAGED[:1])
    tried = []
    earlier = start if start is not None and start.is_layered and winds == LEARNT else None
    if winds == LEARNT:
        tried.append(identification.layers(earlier))
    elif winds == ASSUMED:
        tried.append(identification.of_winds(site.wind_m_per_s))
    if earlier is None:  # else the comparison was made before
        anywhere = identification.anywhere()
        # A line that the winds explain is no vibration in either model.
        tried.append(replace(anywhere, vibrations=tried[0].vibrations) if tried else anywhere)
    models = []
    total = len(tried) * sum(steps for _, steps in STEPS)
    done = itertools.count(1)

    def advance() -> None:
        if progress is not None:
            progress(next(done), total)

    make = _pseudo_open_loop if kind == POLC else partial(_kalman, advance)
    for identified in tried:
        text = f"{identified.summary()}, noise variance x {identified.noise_factor:.2f}"
        model = replace(plain, noise_factor=identified.noise_factor, description=text)
        models.append(replace(make(model, plant, telemetry, identified), identified=identified))
    best = min(models, key=lambda model: model.left[0])
    return best.with_noise(noise_scale) if kind == KALMAN else best


def _kalman(
    advance: Advance, model: ControlModel, plant: LoopPlant, telemetry: OpenLoopTelemetry, fit: Identified
) -> ControlModel:
    """Return the model with its Kalman filter and residual."""
    variance, covariance = usual_noise(telemetry.scaled(fit.noise_factor))
    if len(variance) > _MOST_SLOPES:
        arrays = local_filter(fit.layers, 1 / fit.rate_hz, variance, advance, covariance)
    else:
        slopes = fit.slope_model()
        arrays = {
            "first": slopes.first,
            "second": slopes.second,
            "driving_px2": slopes.driving,
            "variance_px2": variance,
            "covariance_xy_px2": covariance,
        }
    return replace(model, arrays=arrays).scored(plant, telemetry)


def _modal(model: ControlModel, plant: LoopPlant, telemetry: OpenLoopTelemetry) -> ControlModel:
    """Return the model with one gain per mode."""
    trust = max(float(telemetry.trust.mean()), 1e-6)  # by which slopes are smaller than they should be
    weighted = telemetry.trust * telemetry.open_loop_px / trust
    modes = weighted @ plant.reconstructor.matrix.T @ plant.reconstructor.modes
    gains = modal_gains(modes, plant.delay_frames, plant.leak) / trust
    gains = np.minimum(gains, _LARGEST_PART * largest_stable_gain(plant.delay_frames))
    text = f"gains {gains.min():g} to {gains.max():g}"
    return replace(model, arrays={"gains": gains}, description=text).scored(plant, telemetry)


def _pseudo_open_loop(
    model: ControlModel, plant: LoopPlant, telemetry: OpenLoopTelemetry, turbulence: Identified
) -> ControlModel:
    """Return the model with pseudo-open-loop control for the time at which the command acts."""
    covariances = turbulence.covariances_px2().sum(axis=0)
    arrays = {"now_px2": covariances[0], "ahead_px2": covariances[min(plant.delay_frames, 2)]}
    models = [
        replace(model, arrays={**arrays, "gain": np.array(gain)}).scored(plant, telemetry)
        for gain in _POLC_GAINS
    ]
    return min(models, key=lambda scored: scored.left[0])
