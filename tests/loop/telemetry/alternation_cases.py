"""Closed loops of methods that alternate, whose residual phase and centroid gains are known."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from faintspot.loop.control.flattening import residual_phase
from faintspot.loop.control.reconstructor import make_reconstructor
from faintspot.loop.slope_covariance import ARCSEC
from faintspot.loop.telemetry.alternation import AlternatingLoop

Floats = NDArray[np.float64]

SIDE, DELAY, LOOP_GAIN = 5, 2, 0.4
CELLS = np.argwhere(np.ones((SIDE, SIDE)))
SUBAPERTURE_M, PIXEL_ARCSEC, RATE_HZ = 0.6, 0.1, 250.0


def corner_matrix() -> Floats:
    """Return slopes (2 n, commands) of a mirror with an actuator at each corner of the sub-apertures."""
    apart = np.argwhere(np.ones((SIDE + 1, SIDE + 1))) - CELLS[:, None]
    beside = ((apart == 0) | (apart == 1)).all(axis=2)
    return np.vstack([beside * (apart[..., axis] - 0.5) for axis in (1, 0)])


MATRIX = corner_matrix()


@dataclass(frozen=True, eq=False)
class KnownLoop:
    """A loop, and what is true of it."""

    loop: AlternatingLoop
    phase_m2: Floats
    """(frames,): residual phase variance within the mirror's reach."""


def alternating(
    frames: int = 6000,
    every: int = 50,
    *,
    noise_px: Sequence[float] = (0.1, 0.05),
    gains: Sequence[float] = (1.0, 1.0),
    seed: int = 1,
) -> KnownLoop:
    """Simulate an integrator in turbulence that the mirror can correct, whose strength drifts."""
    rng = np.random.default_rng(seed)
    reconstructor = make_reconstructor(MATRIX)
    method = np.arange(frames) // every % len(gains)
    strength = np.exp(0.3 * np.sin(2 * np.pi * np.arange(frames) / 2500 + seed))
    turbulence, speed = np.zeros((2, MATRIX.shape[1]))  # smooth: what is white is noise
    commands = np.zeros((frames + DELAY, MATRIX.shape[1]))
    slopes, true = np.zeros((frames, len(MATRIX))), np.zeros((frames, len(MATRIX)))
    driving = 0.004 * rng.standard_normal((frames, MATRIX.shape[1]))
    noise = rng.standard_normal(slopes.shape)
    for frame in range(frames):
        speed = 0.94 * speed + driving[frame]
        turbulence = 0.99 * turbulence + speed
        true[frame] = MATRIX @ (strength[frame] * turbulence + commands[frame])
        gain = gains[method[frame]]
        slopes[frame] = gain * true[frame] + noise_px[method[frame]] * noise[frame]
        # commands[k + DELAY] is computed from frame k.
        latest = commands[frame + DELAY - 1]
        commands[frame + DELAY] = 0.99 * latest - LOOP_GAIN * reconstructor.matrix @ slopes[frame]
    loop = AlternatingLoop(
        slopes.astype(np.float32),
        commands[DELAY:].astype(np.float32),
        MATRIX,
        CELLS,
        RATE_HZ,
        frame=np.arange(frames),
        time_s=np.arange(frames) / RATE_HZ,
        method=method,
        conditions=np.zeros(frames, np.int64),
        delay_frames=DELAY,
        subaperture_m=SUBAPERTURE_M,
        pixel_scale_arcsec=PIXEL_ARCSEC,
    )
    per_px = PIXEL_ARCSEC * ARCSEC * SUBAPERTURE_M
    phase = true @ (per_px * residual_phase(reconstructor.clean, MATRIX, CELLS)).T
    return KnownLoop(loop, np.square(phase).sum(axis=1))
