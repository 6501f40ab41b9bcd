"""Laser guide stars in the planner: [laser] of the camera file, spots that are tuned on, what is written."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.refusals import refused

import faintspot as fs
from faintspot.base.errors import InputError
from faintspot.experiments import Question
from faintspot.experiments.planner.question import read_camera
from faintspot.experiments.planner.text import foundations
from faintspot.slopes.spots.laser_spots import LaserSpots

FILE = """
[camera]
read_noise_e = 1.0
pixels = 10
[spot]
pixel_scale_arcsec = 0.5
subaperture_m = 0.8
[star]
flux_e = 300
[tune]
search_range_px = 1.0
[layout.grid]
shape = [4, 4]
pixels = 10
[laser]
launch_m = [-5.0, 0.0]
at_m = [3.6, 0.0]
spot_fwhm_arcsec = 1.2
"""


@pytest.mark.slow
def test_tuned_on_spots_of_the_sub_aperture(tmp_path: Path) -> None:
    """The layer's width at 90 km seen from 8.6 m: 2.2 arcsec, 4.4 px."""
    path = tmp_path / "camera.toml"
    path.write_text(FILE, encoding="utf-8")
    answer = fs.tune(Question(**read_camera(path)), rng=np.random.default_rng(1), realisations=300)
    assert answer["ml"].method.psf is not None
    assert "elongated by 4.4 px along 0 deg" in " ".join(foundations(answer))
    answer.save(tmp_path / "faintspot.toml")
    pipeline = fs.SlopePipeline.from_file(tmp_path / "faintspot.toml")
    psf = pipeline.plan.sensor.psf
    assert psf is not None
    assert len(psf.samples) == 16
    width_x, width_y = psf.fwhm_px[-1]
    assert width_x > 1.5 * width_y


def test_a_profile_from_a_file(tmp_path: Path) -> None:
    fs.SodiumProfile.gaussian(fwhm_m=5e3).save(tmp_path / "sodium.npz")
    path = tmp_path / "camera.toml"
    path.write_text(f'{FILE}profile = "sodium.npz"\n', encoding="utf-8")
    spots = read_camera(path)["laser"]
    assert "elongated by 2.2 px" in spots.in_words(0.5, (10, 10))


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("at_m = [3.6, 0.0]", ""),
        ("at_m = [3.6, 0.0]", "at_m = [3.6]"),
        ("launch_m = [-5.0, 0.0]", "launch_m = [nan, 0.0]"),
        ("spot_fwhm_arcsec = 1.2", "spot_fwhm_arcsec = 0"),
        ("spot_fwhm_arcsec = 1.2", "spot_fwhm_arcsec = 1.2\nprofile = 3"),
        ("spot_fwhm_arcsec = 1.2", 'spot_fwhm_arcsec = 1.2\nprofile = "none.npz"'),
        ("spot_fwhm_arcsec = 1.2", "spot_fwhm_arcsec = 1.2\nzenith = 3"),
        ("spot_fwhm_arcsec = 1.2", "spot_fwhm_arcsec = 1.2\nzenith_distance_deg = 90"),
        ("spot_fwhm_arcsec = 1.2", "spot_fwhm_arcsec = 30"),
        ("pixel_scale_arcsec = 0.5", ""),
    ],
)
def test_what_is_refused(tmp_path: Path, old: str, new: str) -> None:
    """Also a window shorter than the spot."""
    path = tmp_path / "camera.toml"
    path.write_text(FILE.replace(old, new), encoding="utf-8")
    with refused():
        Question(**read_camera(path))


def test_not_with_other_spots() -> None:
    spots = LaserSpots([-5.0, 0.0], 1.0, [0.0, 0.0])
    known: dict[str, Any] = {"read_noise_e": 1.0, "pixels": 8, "flux_e": 100.0, "pixel_scale_arcsec": 0.5}
    with pytest.raises(InputError, match="laser"):
        Question(**known, laser=spots, psf=fs.PSF.analytic())
