"""Predictive control of a loop whose matrix has the wrong gain, from a recording alone."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike
from tests.loop.control.control_cases import CELLS, INTERACTION, LAYERS, PHASE_OF_COMMANDS
from tests.loop.control.modal_cases import commands_of_matrices
from tests.loop.telemetry.loop_cases import recorded
from tests.refusals import refused

from faintspot.loop.control.base import CommandDelayLine
from faintspot.loop.control.identification import predictive_control
from faintspot.loop.control.identification.modal_model import LoopOfControl
from faintspot.loop.control.identification.model import Kalman
from faintspot.loop.control.identification.predictive_control import PredictiveControl, learn
from faintspot.loop.control.identification.recording import LoopSystem, Recording

GAIN = 0.5


@pytest.fixture(scope="module")
def recording() -> Recording:
    """Return a loop in radians, whose commands are subtracted, in metres."""
    loop, unit = recorded(2, GAIN), 1e-6
    slopes, commands, scale = unit * loop.slopes, -1e-6 * loop.commands, 0.2 / unit
    matrix = 1e6 * unit * loop.interaction_matrix
    changed = replace(loop, slopes=slopes, commands=commands, interaction_matrix=matrix)
    return replace(changed, pixel_scale_arcsec=scale)


@pytest.fixture(scope="module")
def control(recording: Recording) -> PredictiveControl:
    return learn(recording)


def commands(control: PredictiveControl, slopes: np.ndarray) -> np.ndarray:
    control.reset()
    return np.array([control(row) for row in slopes])


@pytest.mark.slow
def test_what_is_learnt(control: PredictiveControl, recording: Recording, tmp_path: Path) -> None:
    """Winds within 1 m/s; the gain within 15 %, as slopes of bilinear wavefronts are not mean gradients."""
    assert control.delay_frames.value == 2.0
    assert control.centroid_gain.value == pytest.approx(GAIN, rel=0.15)
    speeds = [wind.speed.value for wind in control.winds[:2]]
    assert speeds == pytest.approx([np.hypot(8, 3), np.hypot(6, 14)], abs=1.0)
    control.save(tmp_path / "controller.npz")
    read, rows = PredictiveControl.load(tmp_path / "controller.npz"), recording.slopes[:100]
    np.testing.assert_array_equal(commands(read, rows), commands(control, rows))
    assert (read.winds, read.integrator_gain) == (control.winds, control.integrator_gain)


@pytest.mark.slow
def test_values_that_no_slope_has_count_as_not_measured(
    control: PredictiveControl, recording: Recording
) -> None:
    """In that frame and in those after it; masked slopes, too."""
    rows = recording.slopes[:80].copy()
    rows[10, 3] = rows[40:45, 7] = np.nan
    expected = commands(control, rows)
    assert np.isfinite(expected).all()
    for value in (np.inf, -np.inf, 1e300, -1e300, 1e5):
        wrong = np.where(np.isnan(rows), value, rows)
        np.testing.assert_array_equal(commands(control, wrong), expected)
    np.testing.assert_array_equal(commands(control, np.ma.masked_invalid(rows)), expected)


@pytest.mark.slow
def test_a_row_of_another_shape_is_one_line(control: PredictiveControl) -> None:
    control.reset()
    wrong: list[Any] = [np.zeros((2, 25)), np.zeros(49), "slopes", [[1.0], [2.0, 3.0]], 1j, np.full(50, 1j)]
    for row in (None, *wrong):
        with refused("slopes: expected"):
            control(row)
    for row in wrong:
        with refused("standard_errors: expected"):
            control(np.zeros(50), row)
    assert np.isfinite(control(np.zeros(50))).all()


@pytest.mark.slow
def test_a_dead_sub_aperture_costs_little(recording: Recording, control: PredictiveControl) -> None:
    """It is named, and left out of what is learnt and of the loop."""
    slopes = recording.slopes.copy()
    slopes[:, 12] = 0.0
    dead = learn(replace(recording, slopes=slopes))
    assert dead.left_out.tolist() == [12]
    assert "sub-aperture 12 (row 2, column 2)" in dead.summary()
    # 24 of 25 sub-apertures are the same: half a standard error.
    gain = control.centroid_gain
    assert dead.centroid_gain.value == pytest.approx(gain.value, abs=0.5 * gain.error)
    sent = commands(dead, recording.slopes[:200])
    assert np.isfinite(sent).all()
    wild = recording.slopes[:200].copy()
    wild[:, [12, 37]] *= -3.0
    np.testing.assert_array_equal(commands(dead, wild)[:60], sent[:60])  # the integrator drives


@pytest.mark.slow
def test_exported_matrices_give_the_same_commands(
    control: PredictiveControl, recording: Recording, tmp_path: Path
) -> None:
    """In the unit and with the sign of the recording, within 1e-6 of the largest command."""
    control.export(tmp_path / "controller.npz")
    file = dict(np.load(tmp_path / "controller.npz"))
    line, error = CommandDelayLine(36, 2), np.sqrt(control.model.arrays["variance_px2"])
    alone = control.model.controller(control._plant, line)
    rows = recording.slopes[:300]
    for slopes, command in zip(rows, commands_of_matrices(file, rows), strict=True):
        alone.update(control._loop.scale * slopes, error)
        assert np.abs(command + line.latest).max() <= 1e-6 * np.abs(line.latest).max()
    assert (file["largest_command"] > 0).all()


@pytest.mark.slow
def test_a_wrong_column_of_the_matrix_is_corrected() -> None:
    """A command 2.5 times as strong in the loop as in the matrix, within 2 of the errors of 4 to 5 %."""
    loop = recorded(2, GAIN)
    factors = np.where(np.arange(36) == 14, 0.4, 1.0)
    control = learn(replace(loop, interaction_matrix=factors * loop.interaction_matrix))
    known, corrected = loop.interaction_matrix[:, 14], control._loop.slopes_of_commands[:, 14]
    others = np.delete(loop.interaction_matrix, 14, axis=1)
    scale = np.linalg.norm(np.delete(control._loop.slopes_of_commands, 14, axis=1)) / np.linalg.norm(others)
    assert corrected @ known / (known @ known) / scale == pytest.approx(1.0, abs=0.1)
    assert "1 of 36 commands" in control.summary()


def made(
    sign: float = 1.0, reference: ArrayLike = 0.0, flat: ArrayLike = 0.0, **options: Any
) -> PredictiveControl:
    """Return a controller of 9 sub-apertures with a gain of 0.4; `sign` is that of the user's commands."""
    arrays = {"first": 0.9 * LAYERS.first, "second": LAYERS.second, "driving_px2": LAYERS.driving}
    arrays |= {"variance_px2": np.ones(18), "covariance_xy_px2": np.zeros(9)}
    model = Kalman(arrays, 0.4, 1.0, (1.0, 1.0), PHASE_OF_COMMANDS)
    offsets: dict[str, Any] = {"reference_slopes": np.full(18, reference), "flat_command": np.full(12, flat)}
    system = LoopSystem(INTERACTION, CELLS, 250.0, command_sign=sign, **offsets)
    numbers = np.array([2.0, 0.0, 1.0, 0.0, 1.0, 0.0]), np.zeros((0, 6)), np.full(12, 10.0), 0.4
    loop = LoopOfControl(system, INTERACTION, np.ones(18), np.ones(18), *numbers, **options)
    return PredictiveControl(loop, model)


def test_another_gain_than_the_recorded_one_comes_in_100_frames() -> None:
    """Steps of the integrator, which drives for 60 frames, are in proportion to its gain."""
    eased, plain = made(recorded_gain=0.1), made()
    slopes = np.linspace(0.1, 0.2, 18)
    steps = np.array([[control(slopes + 0.01 * k) for control in (eased, plain)] for k in range(3)])
    first, second = steps[1] - 0.99 * steps[0]
    ratios = 0.25 ** (1 - np.array([0.01, 0.02]))
    np.testing.assert_allclose(steps[0, 0], ratios[0] * steps[0, 1], rtol=1e-5)
    np.testing.assert_allclose(first, ratios[1] * second, rtol=1e-4)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_learning_again_keeps_the_command(monkeypatch: pytest.MonkeyPatch, sign: float) -> None:
    """Slopes of 0 change it by the integrator's leak alone."""
    control, again = made(sign), made(sign)
    monkeypatch.setattr(predictive_control, "learn", lambda recording, start: again)
    held = np.linspace(-1.0, 2.0, 12)
    control.reset(held)
    np.testing.assert_allclose(control(np.zeros(18)), 0.99 * held, atol=1e-6)
    control.learn_again(Recording(np.zeros((400, 18)), None, None, CELLS.astype(int), frame_rate_hz=250.0))
    np.testing.assert_allclose(control(np.zeros(18)), 0.99**2 * held, atol=1e-6)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_commands_are_about_the_flat_one_and_slopes_about_their_references(
    sign: float, tmp_path: Path
) -> None:
    """Stroke included: 55 of 100 leaves 45 either way. 1e-9: sums with the offsets are rounded."""
    rng = np.random.default_rng(1)
    reference, flat = rng.standard_normal(18), np.linspace(45.0, 65.0, 12)
    offset, plain = made(sign, reference, flat), made(sign)
    offset.save(tmp_path / "offset.npz")
    rows = rng.standard_normal((70, 18))
    for held in (np.zeros(12), rng.standard_normal(12)):
        for control in (offset, PredictiveControl.load(tmp_path / "offset.npz")):
            plain.reset(held)
            control.reset(flat + held)
            expected = np.array([plain(row) for row in rows])
            sent = np.array([control(row + reference) for row in rows])
            np.testing.assert_allclose(sent - flat, expected, atol=1e-9)
            for latest, values in zip(control._latest(70), (rows + reference, sent), strict=True):
                np.testing.assert_allclose(latest, values, rtol=1e-6, atol=1e-5)  # float32
    offset.reset()
    np.testing.assert_allclose(offset(reference), flat, atol=1e-9)


def test_a_row_of_zeros_is_not_measured() -> None:
    """With references it would be slopes of minus these."""
    zero, missing = (made(reference=np.full(18, 0.5)) for _ in range(2))
    for row in np.random.default_rng(1).standard_normal((5, 18)):
        zero(row), missing(row)
    np.testing.assert_array_equal(zero(np.zeros(18)), missing(np.full(18, np.nan)))


def test_the_fallback_has_the_matrix_that_ran() -> None:
    corrected = replace(made()._loop, interaction=1.5 * INTERACTION)
    ran = INTERACTION, np.zeros((0, 0))
    plants = [replace(corrected, recorded_interaction=matrix).plant() for matrix in ran]
    np.testing.assert_allclose(
        plants[0].reconstructor.matrix, 1.5 * plants[1].reconstructor.matrix, rtol=1e-9
    )
    np.testing.assert_array_equal(plants[0].reconstructor.clean, plants[1].reconstructor.clean)


@pytest.mark.slow
def test_stroke_is_what_the_flat_command_leaves(recording: Recording) -> None:
    """No command is beyond the limit of the recording, whatever the slopes are."""
    rms = float(recording.commands.std())
    flat, limit = np.linspace(-8.0, 8.0, 36) * rms, 9.0 * rms
    biased = replace(recording, commands=recording.commands + flat, flat_command=flat, largest_command=limit)
    control = learn(biased.part(slice(0, 520)))
    sent = np.array([control(100 * row) for row in recording.slopes[:100]])
    assert np.abs(sent).max() == pytest.approx(limit)


@pytest.mark.slow
def test_bad_recordings_are_refused(recording: Recording) -> None:
    for changes, word in (
        ({"commands": None}, "commands"),
        ({"is_closed": False}, "open"),
        ({"commands": np.zeros((2550, 36))}, "closed loop"),
    ):
        changed: Any = changes
        with refused(word):
            learn(replace(recording, **changed))
