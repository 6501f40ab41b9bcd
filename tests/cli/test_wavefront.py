import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.cli.cli_cases import CONFIGURATION, Commands, simulated
from tests.slopes.sensor.sensor_cases import spot_frame

from faintspot import Layout
from faintspot.base.text_files import parse_json, plain_values
from faintspot.io import read_slopes
from faintspot.slopes.pipeline.configuration import to_text
from faintspot.slopes.pipeline.slopes import Slopes
from faintspot.slopes.wavefront import certify, fit_wavefront
from faintspot.slopes.wavefront.files import certificate_records

SCALES = ("--pixel-scale-arcsec", 0.4, "--diameter-m", 4.2)


@pytest.fixture
def slopes(run: Commands, folder: Path, coarse_pictures: None) -> Path:
    np.save("frames.npy", simulated(6))
    run.ok("slopes", "frames.npy", "-o", "slopes.npz")
    return folder / "slopes.npz"


def test_table_picture_and_files(run: Commands, slopes: Path) -> None:
    out = run.ok("wavefront", slopes, *SCALES, "--wavelength-nm", 700, "-o", "w.json").out
    assert "defocus" in out
    assert "mean (nm)" in out
    assert f"picture: {slopes.parent / 'slopes_wavefront.png'}" in out
    layout = Layout.grid((4, 4), pixels=8, pixel_scale_arcsec=0.4, diameter_m=4.2)
    expected = fit_wavefront(Slopes.from_variables(read_slopes(slopes).variables), layout)
    written = parse_json(Path("w.json").read_text())
    assert written["unknown"] == {}
    assert written["unit"] == "nm"
    assert [mode["noll"] for mode in written["mean"]["modes"]] == list(range(2, 11))
    assert [mode["osa"] for mode in written["mean"]["modes"]] == [2, 1, 4, 3, 5, 7, 8, 6, 9]
    np.testing.assert_allclose(written["frames"]["coefficients"], expected.coefficients)
    mean, error = expected.mean[2], expected.mean_standard_error[2]
    assert [written["mean"]["modes"][2][name] for name in ("mean", "standard_error")] == [mean, error]
    np.testing.assert_allclose(written["frames"]["rms_without_tilt"], expected.rms(tilt=False))
    np.testing.assert_allclose(written["frames"]["standard_errors"], expected.standard_errors)
    np.testing.assert_allclose(written["frames"]["residual_px"], expected.residual_px)
    assert written["mean"]["certificate"] == plain_values(
        certificate_records(certify(expected, wavelength_nm=700.0))
    )
    assert written["mean"]["wavelength_nm"] == 700.0
    assert "Strehl ratio at 700 nm" in out


def test_drift_of_a_recording(run: Commands, slopes: Path, coarse_pictures: None) -> None:
    asked = ("--drift", 3, "--frame-rate-hz", 0.01)
    out = run.ok("wavefront", slopes, *SCALES, *asked, "--modes", 5, "-o", "w.json").out
    assert "nm/h" in out
    assert Path("slopes_drift.png").exists()
    written = parse_json(Path("w.json").read_text())
    coefficients = np.array(written["frames"]["coefficients"])
    np.testing.assert_allclose(written["drift"]["mean"], coefficients.reshape(3, 2, 5).mean(axis=1))
    np.testing.assert_allclose(written["drift"]["time"], np.array([0.5, 2.5, 4.5]) / 36)
    slope = np.polyfit(written["drift"]["time"], written["drift"]["mean"], 1)[0]
    np.testing.assert_allclose(written["drift"]["rate"], slope)


def test_unknown_values_are_null_with_a_reason(run: Commands, folder: Path, no_picture: None) -> None:
    frames = simulated(3)
    frames[1] = 0
    np.save("frames.npy", frames)
    run.ok("slopes", "frames.npy", "-o", "slopes.npz")
    run.ok("wavefront", "slopes.npz", "-o", "w.json")
    written = parse_json(Path("w.json").read_text())
    assert written["pupil_radius_m"] is None
    assert written["frames"]["coefficients"][1] == [None] * 9
    assert set(written["unknown"]) == {"pupil_radius_m", "frames", "strehl"}


def test_without_scales_it_says_its_unit(run: Commands, slopes: Path) -> None:
    result = run.ok("wavefront", slopes, "--modes", 5)
    assert "In pixels times sub-apertures" in result.out
    assert "--pixel-scale-arcsec" in result.out
    assert "Z6" in result.out
    assert "Z7" not in result.out


def test_scales_of_the_configuration_are_stored(run: Commands, slopes: Path) -> None:
    scales = "pixel_scale_arcsec = 0.4\nsubaperture_m = 1.0"
    text = CONFIGURATION.replace("[layout.grid]", f"[layout]\n{scales}\n[layout.grid]")
    Path("faintspot.toml").write_text(text)
    run.ok("slopes", "frames.npy", "-o", "scaled.npz")
    assert "mean (nm)" in run.ok("wavefront", "scaled.npz").out


def test_command_that_flattens(run: Commands, slopes: Path, coarse_pictures: None) -> None:
    np.save("mirror.npy", np.random.default_rng(1).normal(size=(32, 6)))
    out = run.ok("wavefront", slopes, "--actuators", "mirror.npy").out
    assert "The command removes" in out
    assert Path("slopes_command.png").exists()
    command = np.load("slopes_command.npy")
    assert command.shape == (6,)
    limit = 0.5 * float(np.abs(command).max())
    asked = ("--actuators", "mirror.npy", "--stroke", limit, "--command", "c.csv")
    assert "at the stroke limit" in run.ok("wavefront", slopes, *SCALES, *asked).out
    with Path("c.csv").open() as stream:
        clipped = [float(row["command"]) for row in csv.DictReader(stream)]
    assert np.abs(clipped).max() == pytest.approx(limit)
    assert Path("c.png").exists()


@pytest.mark.slow
def test_difference_of_two_recordings(run: Commands, slopes: Path, no_picture: None) -> None:
    asked = ("--modes", 2, "-o", "w.json")
    run.ok("wavefront", slopes, "--minus", slopes, *asked)
    nothing = parse_json(Path("w.json").read_text())["mean"]
    assert nothing["certificate"]["rms"]["value"] == pytest.approx(0, abs=1e-6)
    np.save("moved.npy", np.roll(np.load("frames.npy"), 1, axis=2))
    run.ok("slopes", "moved.npy", "-o", "moved.npz")
    run.ok("wavefront", "moved.npz", "--minus", slopes, *asked)
    moved = parse_json(Path("w.json").read_text())["mean"]
    alone = fit_wavefront(
        Slopes.from_variables(read_slopes(slopes).variables), Layout.grid((4, 4), pixels=8), modes=2
    )
    assert moved["modes"][0]["mean"] == pytest.approx(1.0, abs=0.1)  # Z2 = 2 x on a radius of 2
    # Both have about the same error.
    error = moved["modes"][0]["standard_error"]
    assert error == pytest.approx(np.sqrt(2) * alone.mean_standard_error[0], rel=0.3)
    # A reference changes the slopes of either recording, not the places of its spots in the frame.
    np.save("reference.npy", np.full(32, 0.7))
    for name in ("moved", "frames"):
        run.ok("slopes", f"{name}.npy", "--reference", "reference.npy", "-o", f"{name}_again.npz")
    for own, other in (("moved_again.npz", slopes), ("moved.npz", "frames_again.npz")):
        run.ok("wavefront", own, "--minus", other, *asked)
        again = parse_json(Path("w.json").read_text())["mean"]
        means = [mode["mean"] for mode in again["modes"]]
        assert means == pytest.approx([mode["mean"] for mode in moved["modes"]], abs=0.02)


@pytest.mark.slow
def test_displaced_source_is_a_tilt(run: Commands, slopes: Path, no_picture: None) -> None:
    """Of a reference displaced by a part of a pitch, which leaves a column of lenslets without light."""
    layout = replace(Layout.grid((4, 4), pixels=8), fitted=("centre",))
    text = CONFIGURATION[CONFIGURATION.index("[estimator]") :]
    Path("fitted.toml").write_text(to_text(layout) + text)
    flat = np.roll(np.load("frames.npy"), 2, axis=2)
    flat[:, :, :8] = 20
    np.save("flat.npy", flat)
    for name, reference in (("flat", ()), ("frames", ()), ("relative", ("--reference", "flat.npz"))):
        frames = "flat.npy" if name == "flat" else "frames.npy"
        run.ok("slopes", frames, "-c", "fitted.toml", *reference, "-o", f"{name}.npz")
    errors, fits = [], []
    for asked in (("relative.npz",), ("frames.npz", "--minus", "flat.npz")):
        out = run.ok("wavefront", *asked, "--modes", 5, "-o", "w.json").out
        wavefront = parse_json(Path("w.json").read_text())
        means = [mode["mean"] for mode in wavefront["mean"]["modes"]]
        # Z2 = 2 x; spots of 400 e- have an error of 0.1 px.
        assert means[0] == pytest.approx(-wavefront["pupil_radius_subapertures"], abs=0.15)
        np.testing.assert_allclose(means[1:], 0, atol=0.1)
        assert "not in these slopes" not in out
        errors.append([mode["standard_error"] for mode in wavefront["mean"]["modes"]])
        fits.append(means)
    # Errors of the reference count either way; without them they would be a factor of 1.4 smaller.
    np.testing.assert_allclose(errors[0], errors[1], rtol=0.2)
    # Sub-apertures without a valid reference count in neither.
    np.testing.assert_allclose(fits[0], fits[1], atol=1e-4)
    Path("flat.npz").unlink()
    assert "flat.npz is taken as exact" in run.ok("wavefront", "relative.npz").out
    assert "not in these slopes" in run.ok("wavefront", "frames.npz").out


@pytest.mark.slow
@pytest.mark.parametrize("apart_px", [3.44, 11.44])
def test_own_layouts_give_equal_modes(run: Commands, folder: Path, no_picture: None, apart_px: float) -> None:
    """A reference lights more lenslets, whose errors cancel, pitches away over another offset and frame."""
    row, column = np.mgrid[:7, :7].reshape(2, -1)
    at = 8.0 * (column + 1) + 8.0j * (row + 1) + 1j
    middle, lit = at[32], np.abs(at - at[32]) < 20.0
    rng = np.random.default_rng(1)
    at = at + rng.normal(0.0, 0.05, at.shape) + 1j * rng.normal(0.0, 0.05, at.shape)
    moved = at + 0.02 * (at - middle) + 0.3
    for name, spots, size, offset in (
        ("star", moved[lit], 66, 20.0),
        ("flat", at + apart_px, 66 + round(apart_px), 300.0),
    ):
        frames = [
            spot_frame(spots, (size, size), flux_e=20000.0, width_px=1.0, seed=seed, background_e=offset)
            for seed in range(3)
        ]
        np.save(f"{name}.npy", np.array(frames))
        run.ok("layout", f"{name}.npy", "-o", f"{name}.toml", "--pitch-px", 8)
        run.ok("slopes", f"{name}.npy", "-c", f"{name}.toml", "-o", f"{name}.npz")
    out = run.ok("wavefront", "star.npz", "--minus", "flat.npz", "--modes", 5, "-o", "w.json").out
    mean = parse_json(Path("w.json").read_text())
    radius = mean["pupil_radius_subapertures"]
    tilt, _, focus, *others = (mode["mean"] for mode in mean["mean"]["modes"])
    assert tilt == pytest.approx((0.3 - apart_px) * radius / 2, abs=0.03)
    assert focus == pytest.approx(0.02 * 8.0 * radius**2 / (4 * np.sqrt(3)), abs=0.02)
    np.testing.assert_allclose(others, 0.0, atol=0.02)
    assert "px away" in out
    assert mean["pupil_centre_px"] == pytest.approx([middle.real, middle.imag], abs=1.0)
