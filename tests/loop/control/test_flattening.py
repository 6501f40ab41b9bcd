from pathlib import Path

import numpy as np
import pytest
from tests.loop.telemetry.alternation_cases import CELLS, SIDE
from tests.loop.telemetry.alternation_cases import MATRIX as CORNERS
from tests.refusals import refused

from faintspot.base.flags import SubapertureFlag
from faintspot.loop.control.flattening import flattening, residual_phase, save_command
from faintspot.loop.control.reconstructor import make_reconstructor
from faintspot.slopes.pipeline.slopes import Slopes

N = 30
RNG = np.random.default_rng(5)
MATRIX = RNG.normal(size=(2 * N, 12))
WANTED = RNG.normal(size=12)


def slopes_of(vectors: np.ndarray) -> Slopes:
    x, y = np.split(np.atleast_2d(vectors).astype(np.float32), 2, axis=1)
    zeros, whole = np.zeros_like(x), np.zeros(x.shape, np.int32)
    errors = np.full_like(x, 0.1)
    return Slopes(x, y, zeros, np.zeros(x.shape, np.uint8), whole, whole, errors, errors, zeros)


def test_command_is_minus_what_made_the_slopes() -> None:
    flat = flattening(slopes_of(np.tile(MATRIX @ WANTED, (4, 1))), MATRIX)
    # A damping of .3 % of the mean square: commands are too small by as much.
    np.testing.assert_allclose(flat.command, -WANTED, rtol=0.02, atol=0.01)
    assert flat.after_px < 0.02 * flat.before_px
    assert flat.noise_px == pytest.approx(0.05)
    assert flat.clipped == 0
    np.testing.assert_allclose(flat.slopes_px, MATRIX @ flat.command)


def test_command_is_that_of_damped_least_squares() -> None:
    slopes = RNG.normal(size=2 * N)
    flat = flattening(slopes_of(slopes), MATRIX)
    damping = 3e-3 * np.sum(MATRIX**2) / 12
    rows = np.concatenate([MATRIX, np.sqrt(damping) * np.eye(12)])
    expected = np.linalg.lstsq(rows, -np.concatenate([slopes, np.zeros(12)]))[0]
    np.testing.assert_allclose(flat.command, expected, rtol=1e-5, atol=1e-6)


def test_invalid_slopes_do_not_count() -> None:
    vectors = np.tile(MATRIX @ WANTED, (3, 1))
    slopes = slopes_of(vectors)
    slopes.x[:, 3], slopes.flags[:, 3] = 50.0, int(SubapertureFlag.NO_FLUX)  # never valid
    slopes.y[1, 7], slopes.flags[1, 7] = -80.0, int(SubapertureFlag.NO_FLUX)  # once
    np.testing.assert_allclose(flattening(slopes, MATRIX).command, -WANTED, rtol=0.02, atol=0.01)


def test_best_command_within_the_stroke() -> None:
    slopes = slopes_of(MATRIX @ WANTED)
    free, stroke = flattening(slopes, MATRIX), 0.6
    bounded = flattening(slopes, MATRIX, stroke)
    assert np.abs(bounded.command).max() <= stroke
    assert bounded.clipped == np.count_nonzero(np.abs(bounded.command) > 0.599) > 0
    simply_clipped = np.clip(free.command, -stroke, stroke)
    left = float(np.sqrt(np.mean((MATRIX @ (WANTED + simply_clipped)) ** 2)))
    assert bounded.after_px < left
    assert any("stroke limit" in line for line in bounded.remarks())
    # No actuator can be moved on its own, within the stroke, to lessen what is left.
    for actuator in range(12):
        for step in (-1e-2, 1e-2):
            moved = bounded.command.copy()
            moved[actuator] = np.clip(moved[actuator] + step, -stroke, stroke)
            assert np.sqrt(np.mean((MATRIX @ (WANTED + moved)) ** 2)) > 0.999 * bounded.after_px
    np.testing.assert_array_equal(flattening(slopes, MATRIX, 100.0).command, free.command)


def test_what_the_slopes_do_not_show_stays_still() -> None:
    matrix = np.column_stack([MATRIX, np.zeros(2 * N)])  # the last actuator moves no spot
    for stroke in (None, 0.6):
        flat = flattening(slopes_of(MATRIX @ WANTED), matrix, stroke)
        assert flat.combinations == 12
        assert flat.command[-1] == pytest.approx(0, abs=1e-6)


def test_commands_are_written_as_arrays_or_tables(tmp_path: Path) -> None:
    command = np.array([1.5, -2.0])
    save_command(tmp_path / "c.npy", command)
    np.testing.assert_array_equal(np.load(tmp_path / "c.npy"), command)
    save_command(tmp_path / "c.csv", command)
    assert (tmp_path / "c.csv").read_text() == "actuator,command\n0,1.5\n1,-2\n"
    with refused(".npy, .csv"):
        save_command(tmp_path / "c.txt", command)


def test_matrices_that_do_not_fit_are_refused() -> None:
    slopes = slopes_of(MATRIX @ WANTED)
    for matrix, message in (
        (MATRIX.T, "transpose"),
        (MATRIX[:-2], "(58, 12)"),
        (np.full_like(MATRIX, np.nan), "interaction"),
        (np.zeros_like(MATRIX), "zeros"),
    ):
        with refused(message):
            flattening(slopes, matrix)
    for stroke in (0.0, -1.0, np.nan):
        with refused("stroke"):
            flattening(slopes, MATRIX, stroke)
    slopes.flags[:] = int(SubapertureFlag.NO_FLUX)
    with refused("none"):
        flattening(slopes, MATRIX)


def test_residual_phase_is_the_variance_of_the_commands_surface() -> None:
    """The surface of such a mirror is bilinear; it is sampled at the middles of 40 x 40 points a side."""
    matrix = make_reconstructor(CORNERS).matrix
    slopes = np.random.default_rng(1).standard_normal(len(CORNERS))
    heights = (matrix @ slopes).reshape(SIDE + 1, SIDE + 1)
    place = ((np.arange(40) + 0.5) / 40)[:, None]
    between = np.kron(np.eye(SIDE, SIDE + 1), 1 - place) + np.kron(np.eye(SIDE, SIDE + 1, k=1), place)
    variance = (between @ heights @ between.T).var()
    found = np.square(residual_phase(matrix, CORNERS, CELLS) @ slopes).sum()
    np.testing.assert_allclose(found, variance, rtol=1e-3)
