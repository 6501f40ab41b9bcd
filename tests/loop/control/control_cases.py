"""A small loop for the tests of control: 3 x 3 sub-apertures, a mirror that makes any slopes, two layers."""

import numpy as np

from faintspot.loop.control.base import OpenLoopTelemetry
from faintspot.loop.control.flattening import phase_of_commands
from faintspot.loop.control.integrator import LoopPlant
from faintspot.loop.control.kalman.predictor import SlopeModel
from faintspot.loop.control.reconstructor import make_reconstructor
from faintspot.loop.slope_covariance import SlopeTurbulence

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
LAYERS = SlopeModel.of_covariances(np.array([layer.lagged_px2(FRAME_S) for layer in TURBULENCE.layers()]))
INTERACTION = np.random.default_rng(1).standard_normal((18, 12))
ERRORS = np.full(18, 0.3)
PLANT = LoopPlant(INTERACTION, make_reconstructor(INTERACTION), 2, 0.01)
PHASE_OF_COMMANDS = phase_of_commands(INTERACTION, CELLS.astype(int))
PHASE = PHASE_OF_COMMANDS @ PLANT.reconstructor.matrix


def telemetry(
    frames: int = 2000, noise_px: float = 0.5, seed: int = 5, said: float = 1.0, model: SlopeModel = MODEL
) -> OpenLoopTelemetry:
    """Return slopes as a model makes them, with noise; errors are said to be so many times the true ones."""
    rng = np.random.default_rng(seed)
    driving = np.linalg.cholesky(model.driving)
    now = before = np.zeros((model.layers, model.slopes))
    slopes = []
    for _ in range(frames + 300):
        chance = rng.standard_normal((model.layers, model.slopes))
        new = [
            first @ one + second @ two + each @ random
            for first, second, each, one, two, random in zip(
                model.first, model.second, driving, now, before, chance, strict=True
            )
        ]
        now, before = np.array(new), now
        slopes.append(now.sum(axis=0))
    noisy = np.array(slopes[300:]) + noise_px * rng.standard_normal((frames, model.slopes))
    return OpenLoopTelemetry(noisy, np.full(noisy.shape, (said * noise_px) ** 2), np.ones(noisy.shape))
