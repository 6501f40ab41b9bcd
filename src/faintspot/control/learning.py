"""Controllers that learn what they need to know from telemetry, with an integrator to fall back to."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from faintspot.control.base import ASSUMED, LEARNT, Controller
from faintspot.control.commands import CommandDelayLine
from faintspot.control.identification import Identification, Identified
from faintspot.control.kalman import SlopePredictor
from faintspot.control.learnt import (
    CONTROLS,
    INTEGRATOR,
    KALMAN,
    MODAL,
    POLC,
    Learnt,
    Make,
    Model,
    Plant,
)
from faintspot.control.local_kalman import LocalPredictor, local_filter
from faintspot.control.modal_gains import largest_stable_gain, modal_gains
from faintspot.control.phase import residual_phase
from faintspot.control.predictive import Predictive, PseudoOpenLoop
from faintspot.control.telemetry import OpenLoopTelemetry, usual_variance
from faintspot.turbulence.slope_covariance import SlopeTurbulence

__all__ = ["CONTROLS", "INTEGRATOR", "KALMAN", "MODAL", "POLC", "Learnt", "Plant", "learn"]

Floats = NDArray[np.float64]


GAINS = (0.03, 0.05, 0.07, 0.1, 0.13, 0.16, 0.2, 0.25, 0.3, 0.36, 0.43, 0.5, 0.6, 0.7, 0.8)
"""Gains of an integrator that are tried."""
_POLC_GAINS = (0.05, 0.1, 0.2, 0.3, 0.45, 0.65)
_MOST_SLOPES = 300  # whose filter lets each correct all others
_MOST_REPLAYED, _FEWEST_REPLAYED = 1_200_000, 500  # slopes, and frames, by which controllers are compared
_LARGEST_PART = 0.85  # of the gain at which a mode would be unstable where slopes are fully trusted


def learn(
    kind: str,
    plant: Plant,
    telemetry: OpenLoopTelemetry,
    site: SlopeTurbulence,
    rate_hz: float,
    winds: str = LEARNT,
    noise_scale: float = 1.0,
    start: Identified | None = None,
) -> Learnt:
    """Return a controller of the given kind, learnt from telemetry.

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
    """
    cells = np.rint(site.positions_m[:, ::-1] / site.subaperture_m).astype(np.int64)
    phase = residual_phase(plant.reconstructor.matrix, plant.interaction, cells)
    frames = max(_FEWEST_REPLAYED, _MOST_REPLAYED // len(site.positions_m) // 2)
    whole, telemetry = telemetry, telemetry.part(-frames, None)
    gain, plain_left = _best_gain(lambda gain: partial(plant.integrator, gain), plant, telemetry, phase)
    if kind == MODAL:
        return Learnt(plant, _modal(plant, telemetry, gain, plain_left, phase))
    identification = Identification(whole, site, rate_hz)
    tried = [identification.anywhere()]
    if winds == LEARNT:
        tried.append(identification.layers(start))
    elif winds == ASSUMED:
        tried.append(identification.of_winds(site.wind_m_per_s))
    make = _pseudo_open_loop if kind == POLC else _kalman
    made = [(*make(plant, telemetry.scaled(each.noise_factor), each, phase), each) for each in tried]
    left, arrays, found = min(made, key=lambda each: each[0])
    text = f"{found.summary()}, noise variance x {found.noise_factor:.2f}"
    model = Model(kind, arrays, gain, found.noise_factor, (left, plain_left), phase, text)
    return Learnt(plant, model.with_noise(noise_scale) if kind == KALMAN else model, found)


def _kalman(
    plant: Plant, telemetry: OpenLoopTelemetry, found: Identified, phase: Floats
) -> tuple[float, dict[str, Floats]]:
    """Return the Kalman filter's model and its residual."""
    variance = usual_variance(telemetry)
    predictor: SlopePredictor | LocalPredictor
    if len(variance) > _MOST_SLOPES:
        arrays = local_filter(found.layers, 1 / found.rate_hz, variance)
        predictor = LocalPredictor(arrays)
    else:
        model = found.slope_model()
        predictor = SlopePredictor(model, variance)
        arrays = {
            "first": model.first,
            "second": model.second,
            "driving_px2": model.driving,
            "variance_px2": variance,
        }

    def predictive(line: CommandDelayLine) -> Controller:
        return Predictive(line, plant.interaction, predictor, plant.reconstructor.clean)

    return plant.left(predictive, telemetry, phase), arrays


def _modal(
    plant: Plant, telemetry: OpenLoopTelemetry, plain_gain: float, plain_left: float, phase: Floats
) -> Model:
    """Return the model of an integrator with one gain per mode."""
    trust = max(float(telemetry.trust.mean()), 1e-6)  # by which slopes are smaller than they should be
    weighted = telemetry.trust * telemetry.open_loop_px / trust
    modes = weighted @ plant.reconstructor.matrix.T @ plant.reconstructor.modes
    gains = modal_gains(modes, plant.delay_frames, plant.leak) / trust
    gains = np.minimum(gains, _LARGEST_PART * largest_stable_gain(plant.delay_frames))
    left = plant.left(partial(plant.integrator, gains), telemetry, phase)
    text = f"gains {gains.min():g} to {gains.max():g}"
    return Model(MODAL, {"gains": gains}, plain_gain, 1.0, (left, plain_left), phase, text)


def _pseudo_open_loop(
    plant: Plant, telemetry: OpenLoopTelemetry, found: Identified, phase: Floats
) -> tuple[float, dict[str, Floats]]:
    """Return the model of pseudo-open-loop control for the time at which the command acts."""
    covariances, clean = found.covariances_px2().sum(axis=0), plant.reconstructor.clean
    now, ahead = covariances[0], covariances[min(plant.delay_frames, 2)]

    def made(gain: float) -> Make:
        return lambda line: PseudoOpenLoop(line, plant.interaction, now, ahead, clean, gain)

    gain, left = _best_gain(made, plant, telemetry, phase, _POLC_GAINS)
    return left, {"now_px2": now, "ahead_px2": ahead, "gain": np.array(gain)}


def _best_gain(
    made: Callable[[float], Make],
    plant: Plant,
    telemetry: OpenLoopTelemetry,
    phase: Floats,
    gains: Sequence[float] = GAINS,
) -> tuple[float, float]:
    """Return the gain with the smallest residual on the telemetry, and that residual."""
    left = [plant.left(made(gain), telemetry, phase) for gain in gains]
    best = int(np.argmin(left))
    return gains[best], left[best]
