"""Pokes of a mirror: what they find is true within its errors, and what cannot be is refused."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.loop.control.control_cases import INTERACTION
from tests.refusals import refused

from faintspot.base.flags import SubapertureFlag
from faintspot.loop.control.configuration import load_control, save_control
from faintspot.loop.control.mirror_calibration import (
    calibrate_mirror,
    centroid_gain,
    save_calibration,
    save_picture,
)
from faintspot.slopes.sensor.layout import Layout

REFERENCE = np.linspace(-0.3, 0.4, 18)


@dataclass
class Mirror:
    """Slopes of a linear mirror with noise; or as told."""

    noise_px: float = 0.05
    stroke: float = np.inf
    interaction: Any = field(default_factory=INTERACTION.copy)
    at_limit: bool = False
    invalid: float = 0.0
    drift_px: float = 0.0
    rng: Any = field(default_factory=lambda: np.random.default_rng(4))
    commands: int = 12
    calls: int = 0
    late: bool = False
    before: Any = 0.0

    def slopes(self, command: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        self.calls += 1
        held = np.clip(command, -self.stroke, self.stroke)
        mean = self.interaction @ held + REFERENCE + self.drift_px * self.calls
        if self.late:  # in the first of both frames the poke before still acts
            mean, self.before = np.stack([REFERENCE + self.before, mean]), mean - REFERENCE
        slopes = mean + self.noise_px * self.rng.standard_normal((2, 18))
        flags = np.zeros((2, 9), np.uint8)
        lost = self.rng.random((2, 9)) < self.invalid
        flags[lost] = SubapertureFlag.NO_FLUX
        slopes[np.tile(lost, 2)] = 0.0
        if self.at_limit and np.abs(command).max() > 0.5:
            flags[:, 2] |= np.uint8(SubapertureFlag.AT_SEARCH_LIMIT)
        return slopes, flags


def test_what_is_found_is_true_within_its_errors() -> None:
    """Of 216 elements in units of their errors (of some rounds) the rms is near 1."""
    found = calibrate_mirror(Mirror(), 1.0, 0.01)
    assert found.answers.all()
    assert np.median(found.relative_error) <= 0.01
    score = (found.interaction - INTERACTION) / found.interaction_error
    assert 0.7 < np.sqrt(np.square(score).mean()) < 1.5
    np.testing.assert_allclose(found.reference, REFERENCE, atol=0.01)
    assert 0.5 < np.sqrt(np.square((found.reference - REFERENCE) / found.reference_error).mean()) < 2
    size = np.linalg.norm(INTERACTION, axis=0)
    deviation = np.linalg.norm(found.interaction - INTERACTION, axis=0) / size
    assert 0.6 < np.sqrt(np.square(deviation / found.relative_error).mean()) < 1.6
    assert found.linearity == pytest.approx(1.0, abs=0.02)


def test_more_is_averaged_until_the_error_is_small() -> None:
    rounds = [calibrate_mirror(Mirror(), 1.0, error, 1000).rounds for error in (0.03, 0.006)]
    assert rounds[0] < rounds[1]
    with refused("10 rounds"):
        calibrate_mirror(Mirror(), 1.0, 0.001, 10)


def test_a_drift_is_averaged_out() -> None:
    found = calibrate_mirror(Mirror(0.001, drift_px=0.01), 1.0, 0.02)
    np.testing.assert_allclose(found.interaction, INTERACTION, atol=0.01)


def test_actuators_that_are_dead_are_told_and_not_used() -> None:
    mirror = Mirror()
    mirror.interaction[:, [3, 7]] = 0.0
    found = calibrate_mirror(mirror, 1.0, 0.02)
    np.testing.assert_array_equal(np.flatnonzero(~found.answers), [3, 7])
    assert not found.interaction[:, [3, 7]].any()


def test_some_slopes_may_be_lost() -> None:
    """One that is lost in both frames of a poke is not measured in that round."""
    found = calibrate_mirror(Mirror(0.01, invalid=0.15), 1.0, 0.01)
    np.testing.assert_allclose(found.interaction, INTERACTION, atol=0.05)
    np.testing.assert_allclose(found.reference, REFERENCE, atol=0.05)


def test_what_is_refused() -> None:
    for changes, word, pattern in (
        ({"interaction": 0 * INTERACTION}, "pokes of 1", None),
        ({"interaction": 0 * INTERACTION, "noise_px": 0.0}, "mirror", None),
        ({"stroke": 0.6}, "0.50 expected", r"slopes 0\.8[0-6]"),  # 0.5 of 0.6, and noise
        ({"late": True}, "in the first of the frames", None),
        ({"at_limit": True}, "11 %", "amplitude = 1"),
        ({"invalid": 0.5, "noise_px": 3.0}, "at most 20 %", None),
    ):
        with refused(word, match=pattern):
            calibrate_mirror(Mirror(**changes), 1.0, 0.02, 20)
    for values in ((0.0, 0.1, 9), (1.0, 0.0, 9), (1.0, 0.1, 3), (np.nan, 0.1, 9)):
        with refused():
            calibrate_mirror(Mirror(), *values)


def test_the_gain_against_a_former_matrix() -> None:
    found = calibrate_mirror(Mirror(interaction=0.8 * INTERACTION), 1.0, 0.01)
    gain, error = centroid_gain(found, INTERACTION)
    assert gain == pytest.approx(0.8, abs=5 * error)
    assert 0 < error < 0.01


def test_the_files_are_those_that_control_reads(tmp_path: Path) -> None:
    path = tmp_path / "faintspot.toml"
    np.save(tmp_path / "old.npy", INTERACTION)
    save_control(path, interaction_matrix="old.npy", gain=0.3, centroid_gain=0.7)
    found = calibrate_mirror(Mirror(), 1.0, 0.02)
    store = save_calibration(path, found, found.reference)
    control = load_control(path)
    assert control is not None
    np.testing.assert_array_equal(control.interaction, found.interaction)
    np.testing.assert_array_equal(control.reference, found.reference)
    assert (control.options.gain, control.options.centroid_gain) == (0.3, 1.0)
    assert store.name == "faintspot.control.npz"
    pytest.importorskip("matplotlib")
    picture = tmp_path / "picture.png"
    save_picture(picture, found, found.reference, Layout.grid((3, 3), pixels=8))
    assert picture.read_bytes()[:4] == b"\x89PNG"
