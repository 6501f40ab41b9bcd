"""Controllers that learn what they need to know from telemetry, with an integrator to fall back to."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.control.base import Controller
from faintspot.control.commands import CommandDelayLine
from faintspot.control.identification import Strengths, identify
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
from faintspot.control.modal_gains import largest_stable_gain, modal_gains
from faintspot.control.models import SlopeModel
from faintspot.control.phase import residual_phase
from faintspot.control.predictive import Predictive, PseudoOpenLoop
from faintspot.control.telemetry import OpenLoopTelemetry, usual_variance

__all__ = ["CONTROLS", "INTEGRATOR", "KALMAN", "MODAL", "POLC", "Learnt", "Plant", "learn"]

Floats = NDArray[np.float64]

_GAINS = (0.03, 0.05, 0.07, 0.1, 0.13, 0.16, 0.2, 0.25, 0.3, 0.36, 0.43, 0.5, 0.6, 0.7, 0.8)
_POLC_GAINS = (0.05, 0.1, 0.2, 0.3, 0.45, 0.65)
_LARGEST_PART = 0.85  # of the gain at which a mode would be unstable where slopes are fully trusted


def learn(
    kind: str,
    plant: Plant,
    telemetry: OpenLoopTelemetry,
    theories_px2: Mapping[str, Floats],
    cells: ArrayLike,
    noise_scale: float = 1.0,
) -> Learnt:
    """Return a controller of a kind that has learnt from telemetry.

    Parameters
    ----------
    kind : str
        One of `CONTROLS` but the plain integrator.
    plant : Plant
    telemetry : Telemetry
    theories_px2 : mapping of (layers, 3, m, m) arrays
        Theoretical covariances of each layer's slopes for lags of 0, 1 and 2 frames, by name; at least one
        theory. Their strength as a whole is taken from telemetry.
    cells : (n, 2) array of int
        Row and column of each sub-aperture in the lenslet array.
    noise_scale : float
        What to multiply the variance of the noise by that telemetry shows.
    """
    phase = residual_phase(plant.reconstructor, plant.interaction, cells)
    gain, plain_left = _best_gain(lambda gain: partial(plant.integrator, gain), plant, telemetry, phase)
    if kind == MODAL:
        return Learnt(plant, _modal(plant, telemetry, gain, plain_left, phase))
    if kind == POLC:
        of_all = theories_px2, noise_scale, gain, plain_left, phase
        return Learnt(plant, _pseudo_open_loop(plant, telemetry, *of_all))
    clean = plant.reconstructor.clean

    def predictive(model: SlopeModel, variance_px2: Floats, line: CommandDelayLine) -> Controller:
        return Predictive(line, plant.interaction, SlopePredictor(model, variance_px2), clean)

    def score(model: SlopeModel, frames: OpenLoopTelemetry) -> float:
        return plant.left(partial(predictive, model, usual_variance(frames)), frames, phase)

    found = identify(telemetry, theories_px2, score)
    factor, model = found.noise_factor, found.model
    text = f"{found.source}, noise variance x {factor:.2f}"
    arrays = {
        "first": model.first,
        "second": model.second,
        "driving_px2": model.driving,
        "variance_px2": usual_variance(telemetry.scaled(factor)),
    }
    learnt = Model(kind, arrays, gain, factor, (found.score, plain_left), phase, text)
    return Learnt(plant, learnt.with_noise(noise_scale))


def _modal(
    plant: Plant, telemetry: OpenLoopTelemetry, plain_gain: float, plain_left: float, phase: Floats
) -> Model:
    """Return what an integrator with a gain for each mode needs."""
    trust = max(float(telemetry.trust.mean()), 1e-6)  # by which slopes are smaller than they should be
    weighted = telemetry.trust * telemetry.open_loop_px / trust
    modes = weighted @ plant.reconstructor.matrix.T @ plant.reconstructor.modes
    gains = modal_gains(modes, plant.delay_frames, plant.leak) / trust
    gains = np.minimum(gains, _LARGEST_PART * largest_stable_gain(plant.delay_frames))
    left = plant.left(partial(plant.integrator, gains), telemetry, phase)
    text = f"gains {gains.min():g} to {gains.max():g}"
    return Model(MODAL, {"gains": gains}, plain_gain, 1.0, (left, plain_left), phase, text)


def _pseudo_open_loop(
    plant: Plant,
    telemetry: OpenLoopTelemetry,
    theories_px2: Mapping[str, Floats],
    noise_scale: float,
    plain_gain: float,
    plain_left: float,
    phase: Floats,
) -> Model:
    """Return what pseudo-open-loop control needs, for the wavefront of when the command acts."""
    strengths = Strengths.of(telemetry)
    factor = noise_scale * strengths.noise_factor
    frames, clean = telemetry.scaled(factor), plant.reconstructor.clean
    tried = []
    for name, layers in theories_px2.items():
        theory = layers.sum(axis=0)
        covariances = strengths.relative_to(theory) * theory
        now = covariances[0]
        ahead = covariances[min(plant.delay_frames, 2)]

        def made(gain: float, now: Floats = now, ahead: Floats = ahead) -> Make:
            return lambda line: PseudoOpenLoop(line, plant.interaction, now, ahead, clean, gain)

        gain, left = _best_gain(made, plant, frames, phase, _POLC_GAINS)
        arrays = {"now_px2": now, "ahead_px2": ahead, "gain": np.array(gain)}
        tried.append((left, f"{name}, gain {gain:g}", arrays))
    left, text, arrays = min(tried, key=lambda each: each[0])
    return Model(POLC, arrays, plain_gain, factor, (left, plain_left), phase, text)


def _best_gain(
    made: Callable[[float], Make],
    plant: Plant,
    telemetry: OpenLoopTelemetry,
    phase: Floats,
    gains: Sequence[float] = _GAINS,
) -> tuple[float, float]:
    """Return the gain that leaves least of telemetry, and how much."""
    left = [plant.left(made(gain), telemetry, phase) for gain in gains]
    best = int(np.argmin(left))
    return gains[best], left[best]
