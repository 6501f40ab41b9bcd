"""Centroid gains from spots that are moved."""

from functools import partial
from typing import Any

import numpy as np
import pytest
from tests.patience import mostly_slow
from tests.refusals import assert_each_refused

import faintspot as fs
from faintspot.slopes.estimators.built_in.window import Window
from faintspot.slopes.simulate import Detector, subapertures
from faintspot.slopes.spots.psf import PSF
from faintspot.slopes.spots.shapes import spots
from faintspot.slopes.training import measure_centroid_gain
from faintspot.slopes.training.centroid_gain import CentroidGain, Images, SpotRange, spot_range

FRAMES = 2000
DITHER = 0.3 * np.sin(2 * np.pi * 0.137 * np.arange(FRAMES))


def test_gain_and_its_error() -> None:
    """Of 200 slopes with noise and a slow drift: true gain within the errors, which are the scatter."""
    rng = np.random.default_rng(1)
    true = rng.uniform(0.4, 1.2, 200)
    drift = np.cumsum(rng.normal(0.0, 0.01, (FRAMES, 200)), axis=0)
    moved = np.stack([DITHER, 0.3 * np.cos(2 * np.pi * 0.091 * np.arange(FRAMES))], axis=1)
    slopes = true * moved.repeat(100, axis=1) + drift + rng.normal(0.0, 0.5, (FRAMES, 200))
    found = measure_centroid_gain(slopes, moved)
    away = (found.gain.T.ravel() - true) / found.standard_error.T.ravel()
    assert abs(away.mean()) < 0.25  # 3.5 standard errors of a mean of 200
    assert 0.85 < away.std() < 1.25  # 20 stretches each know their scatter to 16 %, 200 of them the mean


def test_the_mean_counts_each_by_its_error() -> None:
    found = CentroidGain(np.array([[1.0, 2.0], [5.0, 7.0]]), np.array([[0.1, 0.2], [np.nan, 0.0]]))
    assert found.mean == pytest.approx(((100 * 1.0 + 25 * 2.0) / 125, np.sqrt(1 / 125)))
    assert CentroidGain(found.gain, np.zeros((2, 2))).mean == (3.75, 0.0)


def test_quad_cells_show_their_centroid_gain() -> None:
    """A quad cell's slope is that of its halves; spots 1.3 times as wide show by how much less it moves."""
    pixels = 2
    layout = fs.Layout.grid((2, 2), pixels=pixels)
    moved = np.repeat(np.stack([DITHER, DITHER], axis=1)[:, None], 4, axis=1)
    frames = np.zeros((FRAMES, *layout.frame_shape))
    wide = spots(moved.reshape(-1, 2), shape=(pixels, pixels), profile="gaussian", size=1.3 * 0.6)
    for s, (row, column) in enumerate(layout.corners):
        frames[:, row : row + 2, column : column + 2] = 1e4 * wide.reshape(FRAMES, 4, 2, 2)[:, s]
    settings = fs.Settings(Window(window_fwhm_px=1e3, normalisation="frame"), spot_fwhm_px=1.2)
    pipeline = fs.SlopePipeline(layout, settings, fs.Calibration(read_noise_e=1.0))
    found = measure_centroid_gain(pipeline(frames), np.stack([DITHER, DITHER], axis=1))
    assert found.gain.max() < 0.95
    gain = found.gain.mean(axis=1)
    calibrated = pipeline.with_settings(settings.replace(centroid_gain=gain * prepared_gain(pipeline)))
    again = measure_centroid_gain(calibrated(frames), np.stack([DITHER, DITHER], axis=1))
    np.testing.assert_allclose(again.gain, 1.0, atol=1e-3)


def prepared_gain(pipeline: fs.SlopePipeline) -> Any:
    """The gain that the window takes for the spot's given width: what it divides differences by."""
    prepared: Any = pipeline.plan.prepared
    return 0.5 / np.abs(prepared.weights.x).max()


def test_what_is_refused() -> None:
    assert_each_refused(
        partial(measure_centroid_gain, displacement_px=np.eye(50, 2)),
        slopes=[np.zeros((10, 4)), np.zeros((50, 3)), np.zeros(50)],
    )
    assert_each_refused(
        partial(measure_centroid_gain, np.zeros((50, 4))),
        displacement_px=[np.zeros((50, 3)), np.zeros((50, 2))],
    )


SHAPE, SPOTS = (12, 12), 600
ANYWHERE = 4.0  # px: as far as spots of this window can be told


def measured(flux_e: float, positions: np.ndarray, relative: np.ndarray | float = 1.0) -> SpotRange:
    """Return the range of spots at 3 e- of read noise; it knows the flux only up to a factor of 2."""
    rng = np.random.default_rng(3)
    camera, flux = Detector(read_noise_e=3.0), flux_e * relative * np.ones(len(positions))
    images, _ = subapertures(
        len(positions), shape=SHAPE, flux_e=flux, positions=positions, detector=camera, rng=rng
    )
    references = np.zeros_like(positions)
    return spot_range(
        Images(images.astype(np.float64), references, 2 * flux, 9.0, 1.0), PSF.analytic(radius_px=10)
    )


@pytest.mark.parametrize(
    ("flux_e", "true_px"),
    mostly_slow(1, [(200.0, 0.5), (30.0, 0.0), (30.0, 1.0), (200.0, 2.0), (30.0, ANYWHERE)]),
)
def test_noise_is_not_taken_for_motion(flux_e: float, true_px: float) -> None:
    positions = np.random.default_rng(8).uniform(-true_px, true_px, (SPOTS, 2))
    found = measured(flux_e, positions)
    assert found.is_measured
    assert found.quantile_px == pytest.approx(true_px, abs=0.4 + 0.1 * true_px)  # squares grow by 0.25 px
    assert found.flux_scale == pytest.approx(0.5, rel=0.12)


def test_an_offset_common_to_all_spots_counts_once() -> None:
    positions = np.random.default_rng(8).uniform(-0.3, 0.3, (SPOTS, 2)) + np.array([1.5, -1.0])
    assert measured(60.0, positions).quantile_px == pytest.approx(1.8, abs=0.3)


def test_dim_subapertures_are_as_near_as_bright_ones() -> None:
    flux = np.where(np.arange(SPOTS) % 4, 1.3, 0.1)
    assert measured(60.0, np.zeros((SPOTS, 2)), flux).quantile_px < 0.5


@pytest.mark.parametrize("true_px", mostly_slow(1, [ANYWHERE, 0.0]))
def test_too_little_flux_is_told(true_px: float) -> None:
    positions = np.random.default_rng(8).uniform(-true_px, true_px, (SPOTS, 2))
    assert not measured(2.0, positions).is_measured
