import functools
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.cli.cli_cases import LAYOUT, Commands, simulated

from faintspot import Calibration, Layout, Settings, SlopePipeline
from faintspot.cli.tune import _binned, _save_in_camera_pixels, _sensor
from faintspot.experiments.planner import tuning
from faintspot.slopes.pipeline.configuration import Configuration
from faintspot.slopes.sensor.binning import binned_layout

KNOWN = ("--read-noise-e", 3, "--pixels", 8, "--fwhm-px", "1.8", "--flux-e", 200)


@pytest.fixture(autouse=True)
def quick(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Few spots and fluxes, in an empty folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(tuning, "tune", functools.partial(tuning.tune, realisations=256, steps=1))


def test_answer_configuration_and_picture(run: Commands) -> None:
    LAYOUT.save("layout.toml")
    result = run.ok("tune", *KNOWN, "--config", "layout.toml", "--budget", "0.1")
    for text in ("brightest pixels", "Cramer-Rao", "Recommended: ", "limiting flux", "This rests on"):
        assert text in result.out
    assert max(len(line) for line in result.out.splitlines()) <= 80
    assert Path("faintspot-tune.png").is_file()
    pipeline = SlopePipeline.from_file("faintspot.toml")
    assert len(pipeline.layout) == 16
    assert pipeline.calibration.read_noise_e == 3.0
    assert "faintspot slopes" in result.out


def test_laser_guide_star_of_the_configuration(tmp_path: Path) -> None:
    path = tmp_path / "laser.toml"
    replace(LAYOUT, pixel_scale_arcsec=0.5, subaperture_m=0.8).save(path)
    with path.open("a") as stream:
        stream.write("[laser]\nlaunch_m = [-5.0, 0.0]\nat_m = [1.6, 0.0]\nspot_fwhm_arcsec = 1.2\n")
    found = _sensor(str(path), path, simulated=True)
    assert (found["pixel_scale_arcsec"], found["subaperture_m"]) == (0.5, 0.8)
    assert found["laser"].at_m == pytest.approx([1.6, 0.0])
    assert "laser" not in _sensor(str(path), path, simulated=False)


@pytest.mark.slow
def test_layout_and_calibration_are_asked_for_used_and_kept(run: Commands) -> None:
    assert "faintspot layout FRAME --pixels 8" in run.ok("tune", *KNOWN).out
    calibration = Calibration(dark=100.0, gain_e_per_adu=2.0, read_noise_e=4.0)
    for item in (LAYOUT, calibration):
        item.save("faintspot.toml")
    assert "read noise 4 e-" in run.ok("tune", "--fwhm-px", "1.8", "--flux-e", 200, "--overwrite").out
    pipeline = SlopePipeline.from_file("faintspot.toml")
    assert (len(pipeline.layout), pipeline.calibration) == (16, calibration)


@pytest.mark.slow
def test_tuning_in_binned_pixels(run: Commands) -> None:
    layout = Layout.grid((4, 4), pixels=16, bin=2, frame_shape=(65, 65))
    layout.save("layout.toml")
    Calibration(dark=100.0, read_noise_e=1.5).save("layout.toml")
    values = ("--fwhm-px", "3.6", "--search-range-px", "2", "--flux-e", 200)
    out = run.ok("tune", "--config", "layout.toml", *values).out
    assert "2 x 2 pixels are summed" in out
    said = " ".join(out.split())
    assert "in 8 x 8 px" in said
    assert "read noise 3 e-" in said
    pipeline = SlopePipeline.from_file("faintspot.toml")
    assert pipeline.layout == layout
    assert (pipeline.calibration.dark, pipeline.calibration.read_noise_e) == (100.0, 1.5)
    assert pipeline.settings.search_range_px == 2.0


def test_values_of_binned_frames() -> None:
    """Of 3 x 3 pixels: noises add in squares, and lengths are counted in larger pixels."""
    layout = Layout.grid((4, 4), pixels=18, bin=3)
    given = {
        "read_noise_e": 2.0, "background_e": 0.5, "pixel_scale_arcsec": 0.1, "fwhm_px": 6.0,
        "search_range_px": 4.5, "pixels": 18, "budget": "0.3px", "flux_e": 70.0, "gain_e_per_adu": 2.0,
    }  # fmt: skip
    assert _binned(given, layout) == pytest.approx(
        {
            "read_noise_e": 6.0, "background_e": 4.5, "pixel_scale_arcsec": 0.3, "fwhm_px": 2.0,
            "search_range_px": 1.5, "pixels": 6, "budget": 0.1, "flux_e": 70.0, "gain_e_per_adu": 2.0,
            "layout": binned_layout(layout),
        }
    )  # fmt: skip
    assert _binned({"budget": "50mas"}, layout)["budget"] == "50mas"


def test_what_is_found_of_binned_frames_is_written_in_camera_pixels(tmp_path: Path) -> None:
    layout, path = Layout.grid((4, 4), pixels=16, bin=2), tmp_path / "faintspot.toml"
    promise = {"contradicted": False, "flux_e": 100.0, "noise_ratio": 1.1, "measured_px": 0.1}
    answer: Any = SimpleNamespace(
        calibration=Calibration(read_noise_e=3.0),
        best=SimpleNamespace(settings=Settings("smoothed", smoothing_px=0.8)),
        promise=SimpleNamespace(to_table=lambda: promise),
    )
    _save_in_camera_pixels(answer, path, layout)
    described = Configuration(path)
    assert described.layout == layout
    assert described.calibration.read_noise_e == 1.5
    assert described.settings.smoothing_px == 1.6
    assert described.tables["promise"] == {**promise, "measured_px": 0.2}


@pytest.mark.slow
def test_tune_learns_psf_from_frames(run: Commands) -> None:
    np.save("frames.npy", simulated())
    LAYOUT.save("layout.toml")
    arguments = ("--recording", "frames.npy", "--config", "layout.toml", "--gain-e-per-adu", 1)
    result = run.ok("tune", *arguments, "--flux-e", 150)
    assert "PSF learnt" in result.out
    assert len(SlopePipeline.from_file("faintspot.toml").layout) == 16
