"""Slopes in binned frames, in the camera's pixels."""

import numpy as np
import pytest
from tests.refusals import refused

from faintspot import PSF, Calibration, Layout, Settings, SlopePipeline
from faintspot.base.flags import SubapertureFlag
from faintspot.engine.frames.workers import PipelineMaker
from faintspot.slopes.sensor.binning import binned_layout, magnified_layout

LAYOUT = Layout.grid((2, 3), pixels=24, bin=2, frame_shape=(49, 73), pixel_scale_arcsec=0.1)
SETTINGS = Settings("weighted", weight_fwhm_px=7.0, spot_fwhm_px=6.0)


def spots(shift: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """A spot of 4000 electrons and sigma of 2.5 px in each window, displaced by x, y."""
    v, u = np.indices(LAYOUT.frame_shape)
    frame = np.zeros(LAYOUT.frame_shape)
    for x, y in LAYOUT.centres + np.array(shift):
        frame += 4000 / (2 * np.pi * 2.5**2) * np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2 * 2.5**2))
    return frame


def test_slopes_are_in_camera_pixels() -> None:
    slopes = SlopePipeline(LAYOUT, SETTINGS)(spots((1.5, -0.7)))
    np.testing.assert_allclose(slopes.x, 1.5, atol=0.02)
    np.testing.assert_allclose(slopes.y, -0.7, atol=0.02)
    np.testing.assert_allclose(slopes.flux, 4000, rtol=0.02)


def test_reference_and_range_are_in_camera_pixels() -> None:
    reference = np.tile([1.0, 0.5], (6, 1))
    slopes = SlopePipeline(LAYOUT, SETTINGS.replace(search_range_px=1.0), None, reference)(spots((1.5, -0.7)))
    np.testing.assert_allclose(slopes.x, 0.5, atol=0.02)
    np.testing.assert_allclose(slopes.y, -1.0, atol=1e-6)
    assert (slopes.flags & SubapertureFlag.AT_SEARCH_LIMIT).all()


def test_windows_over_64_px() -> None:
    layout = Layout.grid((1, 2), pixels=100, bin=2)
    v, u = np.indices(layout.frame_shape)
    frame = sum(np.exp(-((u - x - 11) ** 2 + (v - y + 7) ** 2) / 50) for x, y in layout.centres)
    slopes = SlopePipeline(layout, Settings("brightest", keep_brightest=100))(1000 * frame)
    np.testing.assert_allclose(slopes.x, 11, atol=0.05)
    np.testing.assert_allclose(slopes.y, -7, atol=0.05)


def test_standard_errors_are_in_camera_pixels() -> None:
    rng, camera = np.random.default_rng(1), Calibration(dark=50.0, read_noise_e=5.0)
    settings = Settings("window", spot_fwhm_px=6.0, flux_e=4000.0)
    frames = rng.poisson(np.broadcast_to(spots(), (400, *LAYOUT.frame_shape))) + rng.normal(
        50.0, 5.0, (400, *LAYOUT.frame_shape)
    )
    slopes = SlopePipeline(LAYOUT, settings, camera)(frames)
    assert slopes.x.std(axis=0).mean() == pytest.approx(slopes.standard_error_x.mean(), rel=0.15)


def test_predictions_are_in_camera_pixels() -> None:
    """The prior of 0.02 px rules over spots elsewhere; one prediction for all frames, or one for each."""
    settings = Settings("map", prior_std_px=0.02, flux_e=100.0)
    psf = PSF.analytic("gaussian", size=1.5)  # in binned pixels
    pipeline = SlopePipeline(LAYOUT, settings, Calibration(read_noise_e=5.0), psf=psf)
    frames, prior = np.stack([spots() / 40] * 2), np.repeat([1.5, -0.7], 6)
    slopes = pipeline(frames, prior)
    np.testing.assert_allclose(slopes.vector, [prior, prior], atol=0.1)
    np.testing.assert_array_equal(slopes.vector, pipeline(frames, prior.reshape(2, 6).T).vector)
    each = pipeline(frames, np.stack([prior, -prior])).vector
    np.testing.assert_array_equal(each[0], slopes.vector[0])
    np.testing.assert_allclose(each[1], -prior, atol=0.1)


def test_one_saturated_pixel_is_seen() -> None:
    frame = np.round(spots()).astype(np.uint16)
    frame[12, 12] = 65_535
    slopes = SlopePipeline(LAYOUT, SETTINGS)(frame)
    assert ((slopes.flags & SubapertureFlag.SATURATED) != 0).tolist() == [True] + 5 * [False]


def test_stages_are_in_camera_pixels() -> None:
    stages = SlopePipeline(LAYOUT, SETTINGS).explain(spots())
    assert stages.calibrated.shape == stages.raw.shape == (6, 24, 24)
    np.testing.assert_allclose(stages.calibrated.sum(axis=(-2, -1)), stages.raw.sum(axis=(-2, -1)), rtol=1e-5)


def test_layout_there_and_back() -> None:
    of_two = binned_layout(LAYOUT)
    assert (of_two.frame_shape, of_two.window, of_two.pixel_scale_arcsec) == ((24, 36), (12, 12), 0.2)
    assert magnified_layout(of_two, 2, LAYOUT.frame_shape) == LAYOUT


def test_settings_scale_what_is_a_distance() -> None:
    halved = Settings("smoothed", smoothing_px=3.0, search_range_px=[1.0, 2.0], flux_e=30.0).magnified(0.5)
    assert (halved.smoothing_px, halved.search_range_px.tolist(), halved.flux_e) == (1.5, [0.5, 1.0], 30.0)


def test_what_cannot_be_binned_is_refused() -> None:
    with refused("layout.corners", "multiples of bin = 2"):
        Layout((64, 64), (8, 8), np.array([[1, 0]]), bin=2)
    with refused("pixels", "multiples of bin = 2"):
        Layout.grid((2, 2), pixels=9, bin=2)
    with refused("pixels", "bin = 2 allows larger windows"):
        Layout.grid((2, 2), pixels=100)
    with refused("layout.bin = 2", "engine", "faintspot slopes"):
        PipelineMaker(LAYOUT, Calibration())
    with refused("layout.bin = 2", "frames"):
        SlopePipeline(LAYOUT, SETTINGS).for_images()
