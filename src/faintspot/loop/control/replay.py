"""Replay of recorded open-loop slopes: the residual that controllers would have left.

The commands that a controller would have sent are added to the recorded open-loop slopes. These commands do
not know the noise of the frame that they act in: that noise adds the same to every controller's residual.
Slopes count by `OpenLoopTelemetry.trust`.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.loop.control.base import CommandDelayLine, Controller, OpenLoopTelemetry, as_estimated
from faintspot.loop.control.reconstructor import Reconstructor

Floats = NDArray[np.float64]


def replayed_frames(
    make: Callable[[CommandDelayLine], Controller],
    telemetry: OpenLoopTelemetry,
    interaction: Floats,
    phase: Floats,
    delay_frames: int,
) -> Floats:
    """Return the squared residual that a controller would have left on recorded frames, (frames,).

    Parameters
    ----------
    make : callable
        Returns the controller, given where its commands go.
    telemetry : OpenLoopTelemetry
    interaction : (m, commands) array
    phase : (k, m) array
        From slopes to what is scored, see `residual_phase`.
    delay_frames : int
    """
    line = CommandDelayLine(interaction.shape[1], delay_frames)
    controller = make(line)
    error, covariance = np.sqrt(telemetry.variance_px2), telemetry.covariances_px2
    residuals = np.zeros_like(telemetry.open_loop_px)
    with np.errstate(over="ignore", invalid="ignore"):  # the residual of an unstable loop overflows
        for frame, slopes in enumerate(telemetry.open_loop_px):
            residual = slopes + interaction @ line.acting
            trust = telemetry.trust[frame]
            residuals[frame] = trust * residual
            try:
                estimated = as_estimated(residual, trust, controller)
                controller.update(estimated, error[frame], covariance[frame])
            except ArithmeticError:  # its commands are not finite
                return np.full(len(residuals), np.inf)
        return np.asarray(np.square(residuals @ phase.T).sum(axis=1))


def replayed_integrators(
    gains: ArrayLike,
    telemetry: OpenLoopTelemetry,
    interaction: Floats,
    reconstructor: Reconstructor,
    phase: Floats,
    delay_frames: int,
    leak: float,
) -> Floats:
    """Return the squared residuals of integrators with several gains, (gains, frames).

    All gains are columns of the same products. Parameters are those of `replayed_frames` and `Integrator`.
    """
    gain = np.asarray(gains, np.float64)
    commands = np.zeros((interaction.shape[1], len(gain)))
    caused = [np.zeros((len(interaction), len(gain))) for _ in range(delay_frames)]  # by the latest commands
    squares = np.zeros((len(telemetry), len(gain)))
    with np.errstate(over="ignore", invalid="ignore"):  # the residual of an unstable loop overflows
        for frame, (slopes, trust) in enumerate(zip(telemetry.open_loop_px, telemetry.trust, strict=True)):
            acting, latest = caused[frame % delay_frames], caused[(frame - 1) % delay_frames]
            slopes_px = trust[:, None] * (slopes[:, None] + acting)
            squares[frame] = np.square(phase @ slopes_px).sum(axis=0)
            slopes_px += (1 - trust)[:, None] * (acting - latest)  # as an estimator with a prior would have
            commands = (1 - leak) * commands - gain * (reconstructor.matrix @ slopes_px)
            caused[frame % delay_frames] = interaction @ commands
        squares[:, ~np.isfinite(commands.sum(axis=0))] = np.inf
    return squares.T


def mean_residual(frames: Floats, telemetry: OpenLoopTelemetry, settle_frames: int) -> float:
    """Return the mean square residual of fully trusted slopes, once the loop has settled; or infinity.

    Parameters
    ----------
    frames : (frames,) array
        As from `replayed_frames`.
    telemetry : OpenLoopTelemetry
    settle_frames : int
        Frames at the start that are not scored.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        mean = float(frames[settle_frames:].mean())
    share = np.square(telemetry.trust[settle_frames:]).mean()
    return float(mean / share) if np.isfinite(mean) and share > 0 else math.inf
