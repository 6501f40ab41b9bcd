"""Tip, tilt and focus removed from slopes: exactly, for valid slopes only, in the matrix and in the loop."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.refusals import refused

import faintspot as fs
from faintspot.base.flags import SubapertureFlag
from faintspot.engine.control.control_loop import ControlLoop
from faintspot.loop.control.configuration import Control, load_control, save_control
from faintspot.loop.control.integrator import MEAN_SQUARE
from faintspot.loop.control.options import ControlOptions
from faintspot.loop.control.removed_modes import RemovedModes
from faintspot.slopes.pipeline.slopes import RESULT_TYPES, Slopes

LAYOUT = fs.Layout.grid((4, 4), pixels=8)
N = len(LAYOUT)
PLACES = LAYOUT.centres
RNG = np.random.default_rng(4)
SLOPES = RNG.standard_normal(2 * N)
FOCUS = (PLACES - PLACES.mean(axis=0)).T.ravel()
TILTS = np.kron(np.eye(2), np.ones((N, 1))) @ [3.0, -2.0]
INTERACTION = RNG.standard_normal((2 * N, 12))


@pytest.mark.parametrize(("name", "added"), [("tip_tilt", TILTS), ("tip_tilt_focus", TILTS + 0.2 * FOCUS)])
def test_they_change_nothing_and_the_rest_stays(name: str, added: np.ndarray) -> None:
    modes = RemovedModes(name, PLACES)
    flags = np.zeros(N, np.uint8)
    flags[[1, 6]] = SubapertureFlag.NO_FLUX
    valid = np.tile(flags == 0, 2)
    left, said = np.where(valid, SLOPES, 0.0), np.zeros(2)
    with_modes = np.where(valid, SLOPES + added, 0.0)
    modes.remove(flags, left, said)
    np.testing.assert_allclose(modes.removed(with_modes, flags), left, atol=1e-12)
    assert said[MEAN_SQUARE] == pytest.approx(np.square(left[valid]).mean())
    basis = np.stack([np.repeat([1.0, 0.0], N), np.repeat([0.0, 1.0], N), FOCUS], axis=1)
    basis = basis[valid, : 2 + (name == "tip_tilt_focus")]
    fitted = basis @ np.linalg.lstsq(basis, SLOPES[valid])[0]
    np.testing.assert_allclose(left[valid], SLOPES[valid] - fitted, atol=1e-12)
    assert not left[~valid].any()


def test_without_modes_nothing_is_touched() -> None:
    np.testing.assert_array_equal(RemovedModes().removed(SLOPES), SLOPES)
    np.testing.assert_array_equal(Control(INTERACTION).controlled, INTERACTION)


def _commands(options: ControlOptions, added: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the commands that follow from slopes, and the guard's residual."""
    loop = ControlLoop(Control(INTERACTION, None, options, positions=PLACES), LAYOUT)
    loop.close()
    x, y = (SLOPES + added).astype(np.float32).reshape(2, N)
    frame = replace(Slopes(*(np.zeros(N, kind) for kind in RESULT_TYPES)), x=x, y=y)
    sent = loop.follow(frame, 0).copy()
    loop.look_after(frame.flux)
    return sent, loop.guard.residual_px


def test_the_loop_and_its_guard_do_not_see_them() -> None:
    """Slopes are single precision, which leaves 1e-6 px of tilts of a few px."""
    for name in ("none", "tip_tilt", "tip_tilt_focus"):
        options = ControlOptions(removed_modes=name)
        without, residual = _commands(options, np.zeros(2 * N))
        sent, seen = _commands(options, TILTS + (0.2 * FOCUS if name == "tip_tilt_focus" else 0.0))
        assert np.allclose(sent, without, atol=1e-5) == (name != "none")
        assert (seen == pytest.approx(residual, rel=1e-4)) == (name != "none")


def test_removed_modes_are_not_driven() -> None:
    """A mirror with a tip-tilt stage: its commands stay 0, and the rest adds no tilt to the slopes."""
    stage = np.kron(np.eye(2), np.ones((N, 1)))
    control = Control(np.hstack([INTERACTION, stage]), None, ControlOptions(removed_modes="tip_tilt"))
    np.testing.assert_allclose(control.reconstructor.matrix[-2:], 0.0, atol=1e-12)
    np.testing.assert_allclose(control.reconstructor.matrix @ TILTS, 0.0, atol=1e-12)


def test_removed_modes_are_read_from_the_table(tmp_path: Path) -> None:
    path = tmp_path / "faintspot.toml"
    np.save(tmp_path / "matrix.npy", INTERACTION)
    LAYOUT.save(path)
    save_control(path, interaction_matrix="matrix.npy", removed_modes="tip_tilt_focus")
    control = load_control(path)
    assert control is not None
    np.testing.assert_allclose(control.removed_modes.removed(FOCUS), 0.0, atol=1e-9)


def test_what_is_refused() -> None:
    for mode, places, word in (
        ("tilt", PLACES, "removed_modes = 'tilt'"),
        ("tip_tilt_focus", None, "removed_modes"),
        ("tip_tilt_focus", PLACES[:, :1], "positions"),
        ("tip_tilt_focus", 0.0 * PLACES, "positions"),
    ):
        with refused(word):
            Control(INTERACTION, None, ControlOptions(removed_modes=mode), positions=places)
    with refused("kalman"):
        Control(INTERACTION, None, ControlOptions(removed_modes="tip_tilt", controller="kalman"))
