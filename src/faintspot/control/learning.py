"""Controllers that learn what they need to know from telemetry, with an integrator to fall back to."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from faintspot.control.base import Controller
from faintspot.control.commands import CommandLine
from faintspot.control.guarded import Guarded
from faintspot.control.identification import Strengths, identify
from faintspot.control.integrator import Integrator
from faintspot.control.kalman import SlopePredictor
from faintspot.control.modal_gains import largest_stable_gain, modal_gains
from faintspot.control.models import SlopeModel
from faintspot.control.predictive import Predictive, PseudoOpenLoop
from faintspot.control.reconstructor import Reconstructor
from faintspot.control.telemetry import Telemetry, replayed, usual_variance

Floats = NDArray[np.float64]
Make = Callable[[CommandLine], Controller]

INTEGRATOR, MODAL, POLC, KALMAN = "integrator", "modal", "polc", "kalman"
CONTROLS = {
    INTEGRATOR: "integrator with one gain",
    MODAL: "integrator with a gain for each mode",
    POLC: "pseudo-open-loop control",
    KALMAN: "predictive Kalman filter",
}
"""Kinds of control, and what reports call them."""

_GAINS = (0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)
_POLC_GAINS = (0.05, 0.1, 0.2, 0.3, 0.45, 0.65)
_LARGEST_PART = 0.85  # of the gain at which a mode would be unstable where slopes are fully trusted
_SETTLE_FRAMES = 50


@dataclass(frozen=True, eq=False)
class Plant:
    """What a controller must know of its loop."""

    interaction: Floats
    """(m, commands): slopes in px that a unit of each command adds."""
    reconstructor: Reconstructor
    delay_frames: int
    leak: float

    def integrator(self, gain: float | Floats, line: CommandLine) -> Controller:
        """Return an integrator of this loop."""
        return Integrator(line, self.interaction, self.reconstructor, gain, self.leak)

    def left(self, make: Make, telemetry: Telemetry) -> float:
        """Return how much a controller would have left, see `replayed`."""
        matrix = self.reconstructor.matrix
        return replayed(make, telemetry, self.interaction, matrix, self.delay_frames, _SETTLE_FRAMES)


@dataclass(frozen=True, eq=False)
class Learnt:
    """A controller that has learnt, ready to be made."""

    plant: Plant
    learnt: Make
    plain: Make
    left: tuple[float, float]
    """Mean square of what the learnt and the plain one leave in telemetry; of the Kalman filter in frames
    that it has not learnt from."""
    noise_factor: float
    expected_std_px: Floats | None
    """(m,): how sure it is of the slopes that it expects; None: it does not know."""
    description: str

    def controller(self, line: CommandLine, prior_std_px: Floats | None = None) -> Guarded:
        """Return the controller; with the estimator's prior where it has one."""
        return Guarded(
            line,
            self.plant.interaction,
            self.plant.reconstructor.matrix,
            self.learnt,
            self.plain,
            prior_std_px=prior_std_px,
            noise_factor=self.noise_factor,
            prefers_plain=self.left[1] < self.left[0],
        )


def learn(
    kind: str,
    plant: Plant,
    telemetry: Telemetry,
    theories_px2: Mapping[str, Floats],
    noise_scale: float = 1.0,
) -> Learnt:
    """Return a controller of a kind that has learnt from telemetry.

    Parameters
    ----------
    kind : str
        One of `CONTROLS` but the plain integrator.
    plant : Plant
    telemetry : Telemetry
    theories_px2 : mapping of (3, m, m) arrays
        Theoretical covariances of the slopes for lags of 0, 1 and 2 frames, by name; at least one. Their
        strength is taken from telemetry.
    noise_scale : float
        What to multiply the variance of the noise by that telemetry shows.
    """
    gain, plain_left = _best_gain(lambda gain: partial(plant.integrator, gain), plant, telemetry)
    plain = partial(plant.integrator, gain)
    if kind == MODAL:
        return _modal(plant, telemetry, plain, plain_left)
    if kind == POLC:
        return _pseudo_open_loop(plant, telemetry, theories_px2, noise_scale, plain, plain_left)
    clean = plant.reconstructor.clean

    def predictive(model: SlopeModel, variance_px2: Floats, line: CommandLine) -> Controller:
        return Predictive(line, plant.interaction, SlopePredictor(model, variance_px2), clean)

    def score(model: SlopeModel, frames: Telemetry) -> float:
        return plant.left(partial(predictive, model, usual_variance(frames)), frames)

    found = identify(telemetry, theories_px2, score)
    factor = noise_scale * found.noise_factor
    variance = usual_variance(telemetry.scaled(factor))
    expected = SlopePredictor(found.model, variance).std_px
    text = f"{found.theory}, measured moments {found.measured_share:g}, noise variance x {factor:.2f}"
    make = partial(predictive, found.model, variance)
    return Learnt(plant, make, plain, (found.score, plain_left), factor, expected, text)


def _modal(plant: Plant, telemetry: Telemetry, plain: Make, plain_left: float) -> Learnt:
    """Return the integrator with a gain for each mode."""
    trust = max(float(telemetry.trust.mean()), 1e-6)  # by which slopes are smaller than they should be
    weighted = telemetry.trust * telemetry.open_loop_px / trust
    modes = weighted @ plant.reconstructor.matrix.T @ plant.reconstructor.modes
    gains = modal_gains(modes, plant.delay_frames, plant.leak) / trust
    gains = np.minimum(gains, _LARGEST_PART * largest_stable_gain(plant.delay_frames))
    make = partial(plant.integrator, gains)
    text = f"gains {gains.min():g} to {gains.max():g}"
    return Learnt(plant, make, plain, (plant.left(make, telemetry), plain_left), 1.0, None, text)


def _pseudo_open_loop(
    plant: Plant,
    telemetry: Telemetry,
    theories_px2: Mapping[str, Floats],
    noise_scale: float,
    plain: Make,
    plain_left: float,
) -> Learnt:
    """Return pseudo-open-loop control, for the wavefront of when the command acts."""
    strengths = Strengths.of(telemetry)
    factor = noise_scale * strengths.noise_factor
    frames, clean = telemetry.scaled(factor), plant.reconstructor.clean
    tried = []
    for name, theory in theories_px2.items():
        covariances = strengths.relative_to(theory) * theory
        now = covariances[0]
        ahead = covariances[min(plant.delay_frames, 2)]

        def made(gain: float, now: Floats = now, ahead: Floats = ahead) -> Make:
            return lambda line: PseudoOpenLoop(line, plant.interaction, now, ahead, clean, gain)

        gain, left = _best_gain(made, plant, frames, _POLC_GAINS)
        tried.append((left, f"{name}, gain {gain:g}", made(gain)))
    left, text, make = min(tried, key=lambda each: each[0])
    return Learnt(plant, make, plain, (left, plain_left), factor, None, text)


def _best_gain(
    made: Callable[[float], Make], plant: Plant, telemetry: Telemetry, gains: Sequence[float] = _GAINS
) -> tuple[float, float]:
    """Return the gain that leaves least of telemetry, and how much."""
    left = [plant.left(made(gain), telemetry) for gain in gains]
    best = int(np.argmin(left))
    return gains[best], left[best]
