"""The report of slopes in files: rebuilt from what they say, and what is missing is said."""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest
from tests.patience import mostly_slow
from tests.refusals import refused
from tests.slopes.recorded.recorded_cases import SETTINGS, Page, sensor, simulated

from faintspot.io import create_writer
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.pipeline import configuration
from faintspot.slopes.pipeline.settings import Settings
from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline
from faintspot.slopes.recorded.measuring import measure_recorded
from faintspot.slopes.recorded.stored import report_of_stored
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.spots.psf import PSF

pytestmark = pytest.mark.usefixtures("undrawn_pictures")
PLAIN = SETTINGS.replace(estimator="brightest")


def store(
    path: Path,
    layout: Layout,
    settings: Settings = SETTINGS,
    calibration: Calibration | None = None,
    errors: Mapping[str, Any] = MappingProxyType({}),
    **changes: Any,
) -> Path:
    """Simulate frames beside the output, measure them and write the slopes; an attribute None is left out."""
    calibration = calibration or Calibration()
    frames = simulated(layout, 5)[0]
    source = path.with_name("frames.npy")
    np.save(source, frames)
    slopes = SlopePipeline(layout, settings, calibration)(frames)
    attributes: dict[str, Any] = {
        "fingerprint": "test",
        "configuration": configuration.to_text(layout, settings, calibration),
        "sources": [str(source)],
        "faintspot_version": "0.1.0",
    } | changes
    with create_writer(
        path,
        n_frames=5,
        n_subapertures=len(layout),
        attributes={name: value for name, value in attributes.items() if value is not None},
        coordinates={"centre_x": layout.centres[:, 0], "centre_y": layout.centres[:, 1]},
    ) as writer:
        writer.append(0, {**slopes.variables, **errors})
    return path


def test_one_store_gives_the_whole_page(tmp_path: Path) -> None:
    page = Page(report_of_stored([store(tmp_path / "slopes.zarr", sensor())]))
    assert len([tag for tag, _ in page.tags if tag == "img"]) == 5
    assert "wavefront" in page.ids
    assert "total-variation denoising of strength 0.3 e-" in page.text
    assert "frames.npy" in page.text
    assert "What to look at first" not in page.text
    assert "Not drawn" not in page.text


def test_two_stores_are_two_methods(tmp_path: Path) -> None:
    first = store(tmp_path / "a.npz", sensor())
    second = store(tmp_path / "b.npz", sensor(), PLAIN)
    page = Page(report_of_stored([first, second]))
    assert "Settings of 'TV denoising'" in page.text
    assert "Settings of 'brightest pixels'" in page.text
    assert "no denoising; 10 brightest of 64 pixels" in page.text
    assert page.ids[-2:] == ["configuration-of-tv-denoising", "configuration-of-brightest-pixels"]


def test_two_stores_of_the_same_kind_are_named_by_their_files(tmp_path: Path) -> None:
    paths = [store(tmp_path / name, sensor()) for name in ("a.npz", "b.npz")]
    assert "Settings of 'b.npz'" in Page(report_of_stored(paths)).text
    with refused("a.npz"):
        report_of_stored([paths[0], paths[0]])


def test_stores_of_different_sensors_are_refused_in_one_line(tmp_path: Path) -> None:
    first = store(tmp_path / "a.npz", sensor())
    smaller = store(tmp_path / "b.npz", sensor((2, 2)))
    plain = sensor()
    moved = Layout(plain.frame_shape, plain.window, plain.corners, plain.centres + 0.5)
    other = store(tmp_path / "c.npz", moved)
    for second, words in ((smaller, "9 sub-apertures"), (other, "the layout of")):
        with refused(words):
            report_of_stored([first, second])
    for paths in ([], [first] * 3):
        with refused("one", "two", f"{len(paths)}"):
            report_of_stored(paths)


@pytest.mark.parametrize(
    ("name", "changes", "words"),
    mostly_slow(
        1,
        [
            ("s.csv", {}, ("which configuration", "median flux", "sub-apertures is not known")),
            ("s.npz", {"configuration": "not [ toml"}, ("configuration stored in s.npz cannot be used",)),
            ("s.npz", {"configuration": "[estimator]\nname = 'tv'\nnoise_std = -1\n"}, ("cannot be used",)),
            ("s.npz", {"configuration": "[layout]\nwindow = [8, 8]\n"}, ("cannot be used",)),
            ("s.npz", {"sources": ["gone.npy"]}, ("Not drawn: gone.npy",)),
            ("s.npz", {"sources": None}, ("does not say where its frames came from",)),
        ],
    ),
)
def test_what_is_not_known_is_said(
    tmp_path: Path, name: str, changes: dict[str, Any], words: tuple[str, ...]
) -> None:
    path = store(tmp_path / name, sensor(), **changes)
    text = Page(report_of_stored([path])).text
    assert all(part in text for part in words)
    assert "/configuration:" not in text
    if changes.get("sources"):
        assert "Not drawn" not in Page(report_of_stored([path], frames=[tmp_path / "frames.npy"])).text


@pytest.mark.slow
def test_calibration_maps_come_from_the_original_configuration(tmp_path: Path) -> None:
    layout = sensor()
    slope = np.indices(layout.frame_shape).sum(axis=0) / 10.0
    calibration = Calibration(dark=slope, gain_e_per_adu=2.0)
    original = tmp_path / "faintspot.toml"
    for item in (layout, SETTINGS, calibration):
        item.save(original)
    path = store(tmp_path / "s.npz", layout, calibration=calibration, configuration_file=str(original))
    text = Page(report_of_stored([path])).text
    assert "Not drawn" not in text
    assert "What to look at first" not in text
    Calibration(dark=-10 * slope, gain_e_per_adu=3.0).save(original)
    text = Page(report_of_stored([path])).text
    assert "has changed since" in text
    assert "positions that differ from those stored" in text
    original.unlink()
    text = Page(report_of_stored([path])).text
    assert "The calibration maps of s.npz are not found" in text
    assert "settings or calibration of s.npz are not known" in text


def measured(folder: Path, name: str, **options: Any) -> Path:
    """Measure frames with an estimator as `faintspot slopes` does; the PSF lies beside the settings."""
    layout = sensor()
    np.save(folder / "frames.npy", simulated(layout, 5)[0])
    configured = folder / f"{name}.toml"
    for item in (layout, Settings(estimator=name, **options), Calibration(read_noise_e=0.3)):
        configuration.save(configured, item)
    if name == "ml":
        psf = PSF.analytic("diffraction", size=1.0)
        configuration.save(configured, PSF(psf.samples, psf.oversampling))
    measure_recorded([folder / "frames.npy"], configured, folder / f"{name}.zarr")
    return folder / f"{name}.zarr"


@pytest.mark.parametrize(
    ("name", "options"),
    mostly_slow(1, [("brightest", {}), ("thresholded", {"threshold_e": 0.5}), ("ml", {})]),
)
def test_page_of_an_estimator_speaks_of_it_alone(tmp_path: Path, name: str, options: dict[str, Any]) -> None:
    text = Page(report_of_stored([measured(tmp_path, name, **options)])).text
    estimator = Settings(estimator=name, **options).estimator
    assert f"Settings {estimator.in_words(9, 64)}" in text
    assert f"Images are those of '{estimator.label}'" in text
    assert "Not drawn" not in text
    for other in ("TV", "total-variation", "iteration"):
        assert other not in text


def test_automatic_settings_have_a_page(tmp_path: Path) -> None:
    path = measured(tmp_path, "tv", noise_std="auto", keep_brightest="auto", spot_fwhm_px=2.0)
    assert "total-variation denoising" in Page(report_of_stored([path])).text


def test_a_psf_that_is_gone_is_said(tmp_path: Path) -> None:
    path = measured(tmp_path, "ml")
    (tmp_path / "ml.toml").unlink()
    assert "Not drawn" not in Page(report_of_stored([path])).text
    (tmp_path / "ml.psf.npz").unlink()
    page = Page(report_of_stored([path]))
    assert "Not drawn: the PSF of ml.zarr is gone" in page.text


@pytest.mark.slow
def test_an_analytic_psf_is_read_from_the_configuration(tmp_path: Path) -> None:
    path = measured(tmp_path, "ml")
    configured = tmp_path / "ml.toml"
    text = configured.read_text()
    start = text.index("[psf]")
    configured.write_text(text[:start] + '[psf]\nprofile = "diffraction"\nsize = 1.0\n')
    measure_recorded([tmp_path / "frames.npy"], configured, path, overwrite=True)
    (tmp_path / "ml.psf.npz").unlink()
    assert "Not drawn" not in Page(report_of_stored([path])).text


def test_slopes_relative_to_a_reference_are_said_to_be(tmp_path: Path) -> None:
    layout = sensor()
    reference = np.full((len(layout), 2), 0.4)
    frames = simulated(layout, 3)[0]
    np.save(tmp_path / "frames.npy", frames)
    configured = tmp_path / "faintspot.toml"
    layout.save(configured)
    SETTINGS.save(configured)
    output = tmp_path / "slopes.npz"
    measure_recorded([tmp_path / "frames.npy"], configured, output, reference=reference)
    text = Page(report_of_stored([output])).text
    assert "slopes are relative to stored reference positions" in text
    assert "positions that differ" not in text
    assert "Not drawn" not in text


def test_slopes_that_are_left_out_are_counted(tmp_path: Path) -> None:
    """Their standard errors do not count either."""
    flags, x = np.zeros((5, 9), np.uint8), np.full((5, 9), 0.05)
    flags[:, 2], flags[1, 3] = 1, 128
    x[:, 2] = 30.0
    errors = {"standard_error_x": x, "standard_error_y": x}
    first = store(tmp_path / "a.npz", sensor(), errors={**errors, "flags": flags})
    page = Page(report_of_stored([first]))
    assert "Left out 1 of 9 sub-apertures, 1 slope of others: dark, limited." in page.text
    kept = store(tmp_path / "b.npz", sensor(), errors={**errors, "flags": flags}, keep=["limited"])
    page = Page(report_of_stored([first, kept]))
    assert "a.npz: Left out 1 of 9 sub-apertures, 1 slope of others: dark, limited." in page.text
    assert "b.npz: Left out 1 of 9 sub-apertures: dark." in page.text
