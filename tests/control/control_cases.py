"""A small loop for the tests of control: 3 x 3 sub-apertures, a mirror that makes any slopes, two layers."""

from __future__ import annotations

import numpy as np

from faintspot.control.learning import Plant
from faintspot.control.models import SlopeModel
from faintspot.control.reconstructor import make_reconstructor
from faintspot.control.telemetry import Telemetry
from faintspot.control.turbulence import SlopeTurbulence

FRAME_S = 0.004
CELLS = np.array([[row, column] for row in range(3) for column in range(3)], np.float64)
TURBULENCE = SlopeTurbulence(
    CELLS[:, ::-1] * 0.6,
    0.6,
    9e-7,
    r0_m=0.15,
    outer_scale_m=25.0,
    fraction=np.array([0.6, 0.4]),
    wind_m_per_s=np.array([[12.0, 4.0], [-5.0, 20.0]]),
)
COVARIANCES = TURBULENCE.lagged_px2(FRAME_S)
MODEL = SlopeModel.of_covariances(COVARIANCES)
INTERACTION = np.random.default_rng(1).standard_normal((18, 12))
ERRORS = np.full(18, 0.3)
PLANT = Plant(INTERACTION, make_reconstructor(INTERACTION), 2, 0.01)


def telemetry(frames: int = 2000, noise_px: float = 0.5, seed: int = 5, said: float = 1.0) -> Telemetry:
    """Return slopes as `MODEL` makes them, with noise; errors are said to be so many times the true ones."""
    rng = np.random.default_rng(seed)
    driving = np.linalg.cholesky(MODEL.driving)
    state, slopes = np.zeros((2, 18)), []
    for _ in range(frames + 300):
        new = MODEL.first @ state[0] + MODEL.second @ state[1] + driving @ rng.standard_normal(18)
        state = np.stack([new, state[0]])
        slopes.append(new)
    noisy = np.array(slopes[300:]) + noise_px * rng.standard_normal((frames, 18))
    return Telemetry(noisy, np.full(noisy.shape, (said * noise_px) ** 2), np.ones(noisy.shape))
