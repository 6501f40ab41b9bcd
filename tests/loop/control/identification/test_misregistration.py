"""Change of a mirror since its matrix was measured, from a loop whose truth is known."""

from functools import lru_cache

import numpy as np
import pytest
from tests.loop.control.frozen_flow import closed_loop, frozen_slopes
from tests.loop.telemetry.loop_cases import AIR, CELLS, CORNERS, RATE_HZ

from faintspot.loop.control.identification.misregistration import (
    Misregistration,
    MovableMatrix,
    change_of_mirror,
)
from faintspot.loop.control.kalman.predictor import SlopeModel, SlopePredictor
from faintspot.loop.control.reconstructor import make_reconstructor

NOISE_PX, FRAMES, WIDTH = 0.3, 1100, 0.9


def matrix_of(x: float = 0.0, y: float = 0.0, turned: float = 0.0, larger: float = 0.0) -> np.ndarray:
    """Return mean gradients over sub-apertures of Gaussian bumps at their corners, moved as a whole."""
    centre = CORNERS.max(axis=0) / 2
    apart = (1 + larger) * (CORNERS - centre)[:, ::-1]  # x, y
    turn = np.array([[np.cos(turned), -np.sin(turned)], [np.sin(turned), np.cos(turned)]])
    at = apart @ turn.T + centre + (x, y)
    along = (np.arange(20) + 0.5) / 20

    def heights(dx: np.ndarray, dy: np.ndarray) -> np.ndarray:
        points = CELLS[:, ::-1][:, None] + np.column_stack(np.broadcast_arrays(dx, dy))
        square = np.square(points[:, :, None] - at).sum(axis=3)
        return np.asarray(np.exp(-square / 2 / (WIDTH * (1 + larger)) ** 2).mean(axis=1))

    one, none = np.ones(1), np.zeros(1)
    return np.vstack([heights(one, along) - heights(none, along), heights(along, one) - heights(along, none)])


@lru_cache(maxsize=1)
def turbulence() -> tuple[np.ndarray, SlopePredictor]:
    """Return open-loop slopes, and the filter that knows their winds."""
    slopes = frozen_slopes(AIR, FRAMES, RATE_HZ, np.random.default_rng(4))
    model = SlopeModel.of_covariances(np.array([layer.lagged_px2(1 / RATE_HZ) for layer in AIR.layers()]))
    return slopes, SlopePredictor(model, np.full(slopes.shape[1], NOISE_PX**2))


def found(true: np.ndarray) -> Misregistration:
    """Return what is found in a loop of another matrix than the one that controls it."""
    (open_loop, predictor), known = turbulence(), matrix_of()
    noise = NOISE_PX * np.random.default_rng(8).standard_normal(open_loop.shape)
    slopes, commands = closed_loop(open_loop, noise, true, make_reconstructor(known).matrix)
    return change_of_mirror(slopes, commands, MovableMatrix(CELLS, known), predictor, 2)


def test_a_matrix_moves_like_its_mirror() -> None:
    """Within 40 % of the change: between sub-apertures and beyond the edge the surfaces are not known."""
    matrix, at = MovableMatrix(CELLS, matrix_of()), np.array([0.1, 0.0, 0.02, -0.03])
    for moved in ((0.3, -0.1, 0.0, 0.0), (0.0, 0.2, 0.09, 0.0), (0.0, 0.0, 0.0, 0.1)):
        true = matrix_of(*moved)
        assert np.linalg.norm(matrix.at(np.array(moved)) - true) < 0.4 * np.linalg.norm(matrix_of() - true)
    for step, change in zip(0.01 * np.eye(4), matrix.changes(at), strict=True):
        expected = (matrix.at(at + step) - matrix.at(at - step)) / 0.02
        assert np.linalg.norm(change - expected) < 0.1 * np.linalg.norm(expected)


@pytest.mark.slow
@pytest.mark.parametrize("moved", [(0.0, 0.0, 0.0, 0.0), (0.25, -0.15, 0.07, 0.0), (0.0, 0.0, 0.0, 0.12)])
def test_a_mirror_that_has_moved(moved: tuple[float, ...]) -> None:
    """Within three errors, and at most so much; a mirror that has not moved is left as it is."""
    change = found(matrix_of(*moved))
    assert (np.abs(change.moved - moved) < 3 * change.error).all()
    assert (change.error < [0.08, 0.08, 0.03, 0.05]).all()
    assert change.has_moved == any(moved)
    if not any(moved):
        assert not change.is_wrong
        assert change.remarks() == []


@pytest.mark.slow
def test_gains_of_commands() -> None:
    """Relative to their mean. A command of no effect and one of twice the effect are sure, others not."""
    factors = np.ones(len(CORNERS))
    factors[14], factors[21] = 0.0, 2.0
    change = found(matrix_of() * factors)
    deviation = (change.gains * factors.mean() - factors) / change.gain_error
    assert np.sqrt(np.square(deviation).mean()) < 1.3
    assert np.flatnonzero(change.factors != 1).tolist() == [14, 21]
    np.testing.assert_allclose(change.corrected(MovableMatrix(CELLS, matrix_of()))[:, 0], matrix_of()[:, 0])


def test_scatter_of_all_gains_is_shrunk() -> None:
    """By the part of it that is not error, 0.8 here; gains as sure as 1 are left when they do not scatter."""
    gains = 1 + 0.2 * np.tile([1.0, -1.0], 20)
    still = np.zeros(4), np.ones(4)
    change = Misregistration(*still, gains, np.full(40, 0.2 / np.sqrt(5)))
    np.testing.assert_allclose(change.factors, 1 + 0.8 * (gains - 1))
    np.testing.assert_array_equal(Misregistration(*still, gains, np.full(40, 0.2)).factors, 1.0)
