"""Laser guide stars in the planner: spots that are tuned on, what is written, what is refused."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.refusals import assert_each_refused, refused

import faintspot as fs
from faintspot.experiments import Question
from faintspot.experiments.planner.text import foundations
from faintspot.slopes.spots.laser_spots import LaserSpots

LASER = {"launch_m": [-5.0, 0.0], "at_m": [3.6, 0.0], "spot_fwhm_arcsec": 1.2}
SCALE = {"pixel_scale_arcsec": 0.5, "subaperture_m": 0.8}


def question(laser: LaserSpots, **changes: Any) -> Question:
    layout = fs.Layout.grid((4, 4), pixels=10)
    known = {"read_noise_e": 1.0, "flux_e": 300.0, "search_range_px": 1.0, "layout": layout, **SCALE}
    return Question(**{**known, **changes}, laser=laser)


@pytest.mark.slow
def test_tuned_on_spots_of_the_sub_aperture(tmp_path: Path) -> None:
    """The layer's width at 90 km seen from 8.6 m: 2.2 arcsec, 4.4 px."""
    asked = question(LaserSpots.from_table(LASER))
    answer = fs.tune(asked, rng=np.random.default_rng(1), realisations=300)
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
    spots = LaserSpots.from_table({**LASER, "profile": "sodium.npz"}, tmp_path / "faintspot.toml")
    assert "elongated by 2.2 px" in spots.in_words(0.5, (10, 10))


def test_what_is_refused() -> None:
    """Also a window shorter than the spot, and other spots beside it."""
    assert_each_refused(
        lambda **changes: question(LaserSpots.from_table({**LASER, **changes})),
        at_m=[[3.6]],
        launch_m=[[np.nan, 0.0]],
        profile=[[3.0]],
        zenith=["3"],
    )
    with refused("none.npz"):
        LaserSpots.from_table({**LASER, "profile": "none.npz"})
    nowhere = {name: value for name, value in LASER.items() if name != "at_m"}
    for values, known in (
        (nowhere, {}),
        ({**LASER, "spot_fwhm_arcsec": 30}, {}),
        (LASER, {"pixel_scale_arcsec": None}),
        (LASER, {"psf": fs.PSF.analytic()}),
    ):
        with refused():
            question(LaserSpots.from_table(values), **known)
