from dataclasses import replace

import numpy as np
from tests.loop.control.control_cases import TURBULENCE, telemetry

from faintspot.loop.control.base import CommandDelayLine, Controller
from faintspot.loop.control.flattening import residual_phase
from faintspot.loop.control.integrator import LoopPlant
from faintspot.loop.control.kalman.compiled import CompiledKalman
from faintspot.loop.control.kalman.predictor import SlopeModel, SlopePredictor
from faintspot.loop.control.reconstructor import make_reconstructor

CELLS = np.array([[row, column] for row in range(5) for column in range(5)])
CORNERS = np.array([[row, column] for row in range(6) for column in range(6)])


def _slopes_of_corners() -> np.ndarray:
    """Return the slopes of a mirror that moves the corners of the sub-apertures, (50, 36)."""
    surfaces = np.eye(36).reshape(36, 6, 6)
    along_x = np.diff(surfaces, axis=2)
    along_y = np.diff(surfaces, axis=1)
    x = 0.5 * (along_x[:, 1:] + along_x[:, :-1])
    y = 0.5 * (along_y[:, :, 1:] + along_y[:, :, :-1])
    return np.hstack([x.reshape(36, -1), y.reshape(36, -1)]).T


INTERACTION = _slopes_of_corners()
PLANT = LoopPlant(INTERACTION, make_reconstructor(INTERACTION), 2, 0.01)
PHASE = residual_phase(PLANT.reconstructor.matrix, INTERACTION, CELLS)


def test_it_is_the_variance_of_the_commands_surface() -> None:
    """The surface of such a mirror is bilinear; it is sampled at the middles of 40 x 40 points a side."""
    slopes = np.random.default_rng(1).standard_normal(50)
    heights = (PLANT.reconstructor.matrix @ slopes).reshape(6, 6)
    place = (np.arange(40) + 0.5) / 40
    lower = np.kron(np.eye(5, 6), (1 - place)[:, None])
    between = lower + np.kron(np.eye(5, 6, k=1), place[:, None])
    surface = between @ heights @ between.T
    np.testing.assert_allclose(np.square(PHASE @ slopes).sum(), surface.var(), rtol=1e-3)


def _left(make: Controller, line: CommandDelayLine, noise_px: float, model: SlopeModel) -> float:
    """Return the phase variance, without noise, that a controller leaves after the first 500 frames."""
    clean, noisy = (telemetry(1500, noise, model=model).open_loop_px for noise in (0.0, noise_px))
    left = []
    for true, measured in zip(clean, noisy, strict=True):
        left.append(np.square(PHASE @ (true + INTERACTION @ line.acting)).sum())
        make.update(measured + INTERACTION @ line.acting, np.full(50, noise_px))
    return float(np.mean(left[500:]))


def test_a_filter_for_reversed_winds_leaves_no_more_than_the_integrator() -> None:
    """Compared by commands, whose weak combinations are mostly noise, it leaves 1.67 times as much."""
    air = replace(
        TURBULENCE,
        positions_m=CELLS[:, ::-1] * 0.6,
        r0_m=0.25,
        wind_m_per_s=np.array([[5.0, 2.0], [-3.0, -10.0]]),
    )
    true, wrong = (
        SlopeModel.of_covariances(np.array([layer.lagged_px2(0.004) for layer in winds.layers()]))
        for winds in (air, replace(air, wind_m_per_s=-np.asarray(air.wind_m_per_s)))
    )
    noise_px, gain = 1.2, 0.1
    lines = [CommandDelayLine(36, 2) for _ in range(3)]
    filters = [
        CompiledKalman(line, PLANT, PHASE, SlopePredictor(model, np.full(50, noise_px**2)), gain)
        for line, model in zip(lines, (true, wrong), strict=False)
    ]
    good, bad = (_left(each, line, noise_px, true) for each, line in zip(filters, lines, strict=False))
    plain = _left(PLANT.integrator(gain, lines[2]), lines[2], noise_px, true)
    assert good < 0.6 * plain
    assert bad < 1.1 * plain
