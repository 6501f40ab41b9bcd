"""Sodium profile of recorded frames: found from a single layer, written by the command, and reported."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.cli.cli_cases import Commands
from tests.patience import mostly_slow
from tests.refusals import refused

import faintspot as fs
from faintspot.io import open_frames
from faintspot.slopes.recorded.sodium import sodium_of_frames
from faintspot.slopes.simulate import sensor_frames
from faintspot.slopes.spots.laser_spots import LaserSpots

LAYOUT = fs.Layout.grid((6, 6), pixels=10, pixel_scale_arcsec=0.5, subaperture_m=1.3)
LASER = LaserSpots([-5.0, 0.0], 0.8)  # narrower than the spots are
STAR = replace(LASER.star_of(LAYOUT), spot=fs.PSF.analytic("gaussian", size=1.2))
TRUE = STAR.focused(fs.SodiumProfile.peaks([86e3, 95e3], [4e3, 3e3], [0.6, 0.4]))
DARK_ADU, FRAMES = 20.0, 300


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Frames whose spots are displaced by up to 0.3 px and move; one pixel is hot."""
    star: dict[str, Any] = {
        "flux_e": 200.0,
        "psf": STAR.psf(TRUE),
        "position_range_px": 0.3,
        "jitter_px": 0.2,
    }
    detector = fs.slopes.simulate.Detector(1.0, offset_adu=DARK_ADU)
    frames, _ = sensor_frames(LAYOUT, FRAMES, **star, detector=detector, rng=np.random.default_rng(1))
    frames[:, 14, 25] = 1e4
    folder = tmp_path_factory.mktemp("sodium")
    np.save(folder / "frames.npy", frames)
    return folder


def calibration() -> fs.Calibration:
    return fs.Calibration(DARK_ADU, read_noise_e=1.0, bad_pixels=np.array([[14, 25]]))


def test_profile_and_spot_are_found(recording: Path) -> None:
    """Two peaks from one: 12 % of the flux is elsewhere, of 30 % in the first estimate; the spot to 5 %."""
    with open_frames([recording / "frames.npy"]) as source:
        known, places, *_ = found = sodium_of_frames(source, LAYOUT, calibration(), LASER)
    profile = known.fit.profile
    density = np.interp(TRUE.altitudes_m, profile.altitudes_m, profile.density, 0.0, 0.0)
    assert 0.5 * np.trapezoid(np.abs(density - TRUE.density), TRUE.altitudes_m) < 0.12
    motion = 0.2**2
    width = 0.5 * np.hypot(2.4, 2.355 * np.sqrt(motion))
    assert known.spot_fwhm_arcsec == pytest.approx(width, rel=0.05)
    np.testing.assert_allclose(known.fit.flux_e, 200.0, rtol=0.05)
    # The lattice of the spots, whose displacements are random, is that of the windows.
    wrong = replace(LAYOUT, centres=1.01 * LAYOUT.centres + 0.5)
    np.testing.assert_allclose(found.lattice_of(wrong).centres, LAYOUT.centres, atol=0.15)
    assert np.abs(places).max() < 0.5


def test_dark_subapertures_are_left_out(recording: Path, tmp_path: Path) -> None:
    """The profile is that of the others: their images are the only ones that weigh."""
    frames = np.load(recording / "frames.npy")
    frames[:, 10:20, 30:40] = DARK_ADU
    np.save(tmp_path / "frames.npy", frames)
    with open_frames([tmp_path / "frames.npy"]) as source:
        found = sodium_of_frames(source, LAYOUT, calibration(), LASER)
    assert found.left_out == "left out 1 of 36 sub-apertures: dark"
    assert list(np.flatnonzero(~found.usable)) == [9]
    np.testing.assert_allclose(np.delete(found.sodium.fit.flux_e, 9), 200.0, rtol=0.05)
    wrong = replace(LAYOUT, centres=1.01 * LAYOUT.centres + 0.5)
    np.testing.assert_allclose(found.lattice_of(wrong).centres, LAYOUT.centres, atol=0.15)


@pytest.mark.slow
def test_command_reads_as_many_frames_as_stated(recording: Path, run: Commands, tmp_path: Path) -> None:
    """The frames after them are saturated, and would hide the spots."""
    frames = np.full((30, *LAYOUT.frame_shape), 6e4, np.float32)
    frames[:4] = np.load(recording / "frames.npy", mmap_mode="r")[:4]
    np.save(tmp_path / "frames.npy", frames)
    path = tmp_path / "faintspot.toml"
    for item in (LAYOUT, calibration(), fs.Settings("ml", search_range_px=2.0)):
        item.save(path)
    line = ("sodium", tmp_path / "frames.npy", "--config", path, "--launch-m", "-5", "0")
    assert "expected images of spots" in run(*line).err
    assert not (tmp_path / "faintspot.sodium.npz").exists()
    run.ok(*line, "--frames", "4")
    with open_frames([tmp_path / "frames.npy"]) as source:
        laser = LaserSpots([-5.0, 0.0], 1.0)
        expected = sodium_of_frames(source, LAYOUT, calibration(), laser, most_frames=4)
    learnt = fs.SodiumProfile.load(tmp_path / "faintspot.sodium.npz")
    np.testing.assert_allclose(learnt.density, expected.sodium.fit.profile.density, rtol=1e-3)


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn_pictures")
def test_sodium_command_writes_what_the_pipeline_knows(recording: Path, run: Commands) -> None:
    """What the command has learnt is what a pipeline of the configuration then knows."""
    path = recording / "faintspot.toml"
    for item in (LAYOUT, calibration(), fs.Settings("ml", search_range_px=2.0)):
        item.save(path)
    line = ("sodium", recording / "frames.npy", "--config", path)
    run.ok(*line, "--launch-m", "-5", "0", "--frames", "200")
    assert (recording / "faintspot.sodium.npz").exists()
    psf = fs.SlopePipeline.from_file(path).spot[0]
    assert psf is not None
    assert len(psf.samples) == len(LAYOUT)
    assert psf.fwhm_px[5, 0] > 1.1 * psf.fwhm_px[0, 0]  # farther from the launch
    slopes = recording / "slopes.npz"
    run.ok("slopes", recording / "frames.npy", "-c", path, "-o", slopes)


@pytest.mark.parametrize("noise", mostly_slow(1, [3.0, 0.43, 0.0]))
@pytest.mark.parametrize("level", [0.0, 7.0, 65535.0])
def test_frames_without_spots_are_refused(tmp_path: Path, level: float, noise: float) -> None:
    rng = np.random.default_rng(3)
    np.save(tmp_path / "none.npy", level + noise * rng.standard_normal((20, *LAYOUT.frame_shape)))
    known = fs.Calibration(read_noise_e=0.43)
    with (
        open_frames([tmp_path / "none.npy"]) as source,
        refused(match="images_e|dark"),
    ):
        sodium_of_frames(source, LAYOUT, known, LASER)
