"""faintspot layout --grid: quad cells from frames to slopes."""

from pathlib import Path

import numpy as np
import pytest
from tests.cli.cli_cases import Commands

from faintspot import Calibration, Layout, Settings
from faintspot.io import read_slopes
from faintspot.slopes.simulate import Detector, sensor_frames

QUAD = Layout.grid((8, 8), pixels=2, outer_radius=4.2, inner_radius=1.0)

pytestmark = pytest.mark.usefixtures("no_picture")


def save_frames(layout: Layout = QUAD) -> None:
    frames, _ = sensor_frames(
        layout,
        20,
        flux_e=500.0,
        position_range_px=0.3,
        detector=Detector(read_noise_e=2.0, offset_adu=100.0),
        rng=np.random.default_rng(1),
    )
    np.save("a.npy", frames)


def test_quad_cells_are_measured_by_their_halves(folder: Path, run: Commands) -> None:
    save_frames()
    out = run.ok("layout", "a.npy", "--grid", "8x8", "-o", "new.toml").out
    assert Layout.load("new.toml").corners.tolist() == QUAD.corners.tolist()
    assert Settings.load("new.toml").estimator.name == "centroid"
    assert Calibration.load("new.toml").dark == pytest.approx(100.0, abs=0.5)  # of the cells that are dark
    run.ok(*out.splitlines()[-1].removeprefix("Next: faintspot ").split())
    images = QUAD.images(np.load("a.npy").astype(float)) - Calibration.load("new.toml").dark
    halves = images.sum(axis=-2)
    expected = 0.5 * (halves[..., 1] - halves[..., 0]) / images.sum(axis=(-2, -1))
    np.testing.assert_allclose(read_slopes("slopes.zarr").variables["x"], expected, atol=1e-5)


def test_a_larger_grid_has_the_usual_settings(folder: Path, run: Commands) -> None:
    save_frames(Layout.grid((4, 4), pixels=12, outer_radius=2.0))
    run.ok("layout", "a.npy", "--grid", "4x4", "-o", "new.toml", "--dark", "100", "--exclude", "0")
    assert len(Layout.load("new.toml")) == 11
    assert Settings.load("new.toml").estimator.name != "centroid"


def test_windows_that_are_smaller_than_the_pitch_are_said(folder: Path, run: Commands) -> None:
    np.save("a.npy", np.random.default_rng(1).normal(100, 1, (262, 262)))
    assert "of a pitch of 131 px" in run.ok("layout", "a.npy", "--grid", "2x2", "-o", "new.toml").out
