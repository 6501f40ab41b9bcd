from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from tests.cli.cli_cases import CONFIGURATION, Commands, simulated

from faintspot import Layout
from faintspot.base.json_text import parse_json
from faintspot.io import read_slopes
from faintspot.slopes.pipeline.slopes import Slopes
from faintspot.slopes.wavefront import fit_wavefront

SCALES = ("--pixel-scale-arcsec", 0.4, "--diameter-m", 4.2)


@pytest.fixture
def slopes(run: Commands, folder: Path, coarse_pictures: None) -> Path:
    np.save("frames.npy", simulated(6))
    run.ok("slopes", "frames.npy", "-o", "slopes.npz")
    return folder / "slopes.npz"


def test_table_picture_and_files(run: Commands, slopes: Path) -> None:
    outputs = [word for name in ("w.csv", "w.json", "w.fits") for word in ("-o", name)]
    out = run.ok("wavefront", slopes, *SCALES, *outputs).out
    assert "defocus" in out
    assert "mean (nm)" in out
    assert "mean wavefront" in out
    assert f"picture: {slopes.parent / 'slopes_wavefront.png'}" in out
    layout = Layout.grid((4, 4), pixels=8, pixel_scale_arcsec=0.4, diameter_m=4.2)
    expected = fit_wavefront(Slopes.from_variables(read_slopes(slopes).variables), layout)
    written = parse_json(Path("w.json").read_text())
    assert written["unknown"] == {}
    assert written["unit"] == "nm"
    assert [mode["noll"] for mode in written["mean"]["modes"]] == list(range(2, 11))
    np.testing.assert_allclose(written["frames"]["coefficients"], expected.coefficients)
    with Path("w.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [row["frame"] for row in rows] == ["mean", *map(str, range(6))]
    np.testing.assert_allclose(
        [float(row["z4_nm"]) for row in rows[1:]], expected.coefficients[:, 2], rtol=1e-6
    )
    np.testing.assert_allclose(
        [float(row["rms_without_tilt_nm"]) for row in rows[1:]], expected.rms(tilt=False), rtol=1e-6
    )
    with fits.open("w.fits", checksum=True) as units:
        assert units[0].header["BUNIT"] == "nm"
        np.testing.assert_allclose(units["MODES"].data["MEAN"], expected.mean)
        np.testing.assert_allclose(units["STANDARD_ERRORS"].data, expected.standard_errors)


def test_unknown_values_are_null_with_a_reason(run: Commands, folder: Path, no_picture: None) -> None:
    frames = simulated(3)
    frames[1] = 0
    np.save("frames.npy", frames)
    run.ok("slopes", "frames.npy", "-o", "slopes.npz")
    run.ok("wavefront", "slopes.npz", "-o", "w.json")
    written = parse_json(Path("w.json").read_text())
    assert written["pupil_radius_m"] is None
    assert written["frames"]["coefficients"][1] == [None] * 9
    assert set(written["unknown"]) == {"pupil_radius_m", "frames"}


def test_without_scales_it_says_its_unit(run: Commands, slopes: Path) -> None:
    result = run.ok("wavefront", slopes, "--modes", 5)
    assert "In pixels times sub-apertures" in result.out
    assert "--pixel-scale-arcsec" in result.out
    assert "Z6" in result.out
    assert "Z7" not in result.out


def test_pictures_of_two_recordings_have_two_names(run: Commands, slopes: Path) -> None:
    for name in ("night.1.npz", "night.2.npz"):
        slopes.with_name(name).write_bytes(slopes.read_bytes())
        run.ok("wavefront", name)
    assert Path("night.1_wavefront.png").exists()
    assert Path("night.2_wavefront.png").exists()


def test_scales_of_the_configuration_are_stored(run: Commands, slopes: Path) -> None:
    scales = "pixel_scale_arcsec = 0.4\nsubaperture_m = 1.0"
    text = CONFIGURATION.replace("[layout.grid]", f"[layout]\n{scales}\n[layout.grid]")
    Path("faintspot.toml").write_text(text)
    run.ok("slopes", "frames.npy", "-o", "scaled.npz")
    assert "mean (nm)" in run.ok("wavefront", "scaled.npz").out


def test_refused(run: Commands, slopes: Path) -> None:
    run.refused("wavefront", "nothing.npz", naming=("nothing.npz",))
    run.refused("wavefront", slopes, "-o", "w.txt", naming=("w.txt", ".csv, .json, .fits"))
    run.refused("wavefront", slopes, "--modes", 30, naming=("modes = 30", "from 2 to 24"))
    run.refused("wavefront", slopes, "--pixel-scale-arcsec", -1, naming=("pixel_scale_arcsec", "-1"))
    run.ok("slopes", "frames.npy", "-o", "slopes.csv")
    run.refused("wavefront", "slopes.csv", naming=("slopes.csv", "layout"))
