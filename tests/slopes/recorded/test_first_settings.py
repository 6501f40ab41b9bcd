"""Settings to begin with: not worse than a fixed window, on spots they were not chosen on."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.patience import mostly_slow

import faintspot as fs
from faintspot.slopes.recorded.first_settings import FirstSettings, first_settings
from faintspot.slopes.spots.shapes import spots

N = 60


def simulated(
    flux_e: float, read_noise_e: float, side: int, seed: int
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Three frames of stacked windows; spots of FWHM 3.6 px within 1.5 px."""
    images, positions = fs.slopes.simulate.subapertures(
        3 * N,
        shape=(side, side),
        flux_e=flux_e,
        size=2.0,
        position_range_px=1.5,
        detector=fs.slopes.simulate.Detector(read_noise_e),
        rng=np.random.default_rng(seed),
    )
    return images.reshape(3, N * side, side), positions.reshape(3, N, 2)


def error(
    settings: fs.Settings, layout: fs.Layout, images: NDArray[np.float32], truth: NDArray[np.float64]
) -> float:
    slopes = fs.SlopePipeline(layout, settings, fs.Calibration(dark=0.0))(images)
    return float(np.abs(np.stack([slopes.x, slopes.y], axis=-1) - truth).mean())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("flux_e", "read_noise_e"), mostly_slow(1, [(50, 0.1), (200, 3.0), (2000, 3.0), (40, 3.0), (10, 3.0)])
)
def test_not_worse_than_a_fixed_window_or_the_reference(flux_e: float, read_noise_e: float) -> None:
    """At most 5 % worse, which is three standard errors of 360 slopes that share their images."""
    side = 27
    shown, _ = simulated(flux_e, read_noise_e, side, 1)
    layout = fs.Layout.stacked(N, (side, side))
    found = first_settings(layout, fs.Calibration(dark=0.0), shown)
    assert found.noise == pytest.approx(read_noise_e, rel=0.15)
    assert (found.response < 1) == (flux_e <= 40)
    images, truth = simulated(flux_e, read_noise_e, side, 2)
    window = fs.Settings("window", spot_fwhm_px=3.6, flux_e=flux_e)
    reached = error(found.settings, layout, images, truth)
    assert reached < 1.05 * error(window, layout, images, truth)
    assert reached < 1.05 * float(np.abs(truth).mean())


@pytest.mark.parametrize("range_px", mostly_slow(1, [0.0, 1.0, 3.0]))
def test_spots_that_move_more_get_a_larger_range(range_px: float) -> None:
    """The whole window, where a smaller range does not help: frames to come may be aberrated more."""
    images, _ = fs.slopes.simulate.subapertures(
        20 * N,
        shape=(20, 20),
        flux_e=100.0,
        size=1.5,
        position_range_px=max(range_px, 0.01),
        detector=fs.slopes.simulate.Detector(3.0),
        rng=np.random.default_rng(3),
    )
    layout = fs.Layout.stacked(N, (20, 20))
    found = first_settings(layout, fs.Calibration(dark=0.0), images.reshape(20, N * 20, 20))
    limit = found.settings.search_range_px
    reach = 10.0 if limit is None else float(limit)
    assert range_px < reach < 2 * range_px + 6.0


def test_without_spots_the_reference_is_the_answer() -> None:
    """The reference is the best answer."""
    noise = np.random.default_rng(1).normal(0.0, 3.0, (1, N * 16, 16))
    layout = fs.Layout.stacked(N, (16, 16))
    found = first_settings(layout, fs.Calibration(dark=0.0), noise)
    assert found.response < 0.2
    assert error(found.settings, layout, noise.astype(np.float32), np.zeros((1, N, 2))) < 0.2


def sharp_spots(fwhm_px: float) -> tuple[FirstSettings, float]:
    """Return first settings, and the error of slopes by the place of a spot in its pixel."""
    places = np.stack([np.linspace(-0.5, 0.5, N), np.arange(N) * 0.382 % 1 - 0.5], axis=1)
    noise = np.random.default_rng(1).normal(0.0, 3.0, (3, N * 16, 16))
    mean = spots(places, shape=(16, 16), flux_e=2e4, profile="gaussian", size=0.5 * fwhm_px)
    layout = fs.Layout.stacked(N, (16, 16))
    found = first_settings(layout, fs.Calibration(dark=0.0), mean.reshape(1, N * 16, 16) + noise)
    psf = None if found.psf is None else fs.PSF.analytic(**found.psf)
    pipeline = fs.SlopePipeline(layout, found.settings, fs.Calibration(dark=0.0, read_noise_e=3.0), psf=psf)
    slopes = pipeline(mean.reshape(N * 16, 16).astype(np.float32))
    errors = np.stack([slopes.x, slopes.y], axis=1) - places
    return found, float(np.abs(errors - errors.mean(axis=0)).max())


@pytest.mark.slow
@pytest.mark.parametrize("fwhm_px", [0.6, 0.7, 0.8, 0.9, 1.0, 1.3])
def test_sharp_spots_at_every_place_in_their_pixels(fwhm_px: float) -> None:
    """Less than 0.03 px of systematic error: the settings, and the PSF where a fit needs it."""
    found, error_px = sharp_spots(fwhm_px)
    assert error_px < 0.03
    assert not found.doubt


def test_spots_that_no_settings_measure_are_doubtful() -> None:
    """Most of them show in a single pixel, which does not say where in it they are."""
    found, error_px = sharp_spots(0.3)
    assert error_px > 0.1
    assert found.doubt


def test_spots_that_overlap_get_a_narrow_weight() -> None:
    """Neighbours at 20 px, of FWHM 12 px, where each lacks those of one side: within 0.1 px."""
    side, pitch, rng = 20, 20.0, np.random.default_rng(2)
    axis = np.arange(side) - 0.5 * (side - 1)
    places = rng.uniform(-0.5, 0.5, (N, 2))
    sums = np.zeros((N, side, side))
    for x in (-pitch, 0.0, pitch):
        for y in (-pitch, 0.0):
            u, v = axis - places[:, :1] - x, axis - places[:, 1:] - y
            sums += 1000 * np.exp(-0.5 * (v[:, :, None] ** 2 + u[:, None, :] ** 2) / 5.1**2)
    layout = replace(fs.Layout.stacked(N, (side, side)), pitch_px=pitch)
    frame = (sums + rng.normal(0.0, 1.0, sums.shape)).reshape(1, N * side, side)
    found = first_settings(layout, fs.Calibration(dark=0.0), frame)
    assert error(found.settings, layout, frame.astype(np.float32), places[None]) < 0.1


def array_of_wide_spots(fwhm_px: float, moved: NDArray[np.float64]) -> tuple[NDArray[np.float64], fs.Layout]:
    """Return frames of 8 x 8 spots at 12 px, all displaced alike, and their layout."""
    layout = replace(fs.Layout.grid((8, 8), pixels=12), pitch_px=12.0)
    away = np.arange(96) - (12 * np.arange(8)[:, None] + 5.5)  # (spots, pixels)
    x, y = (
        np.exp(-4 * np.log(2) * ((away - moved[:, axis, None, None]) / fwhm_px) ** 2).sum(axis=1)
        for axis in range(2)
    )
    return 5000 * y[:, :, None] * x[:, None, :], layout


@pytest.mark.slow
@pytest.mark.parametrize("fwhm_px", [6.0, 8.4])
def test_spots_as_wide_as_their_neighbours_are_far(fwhm_px: float) -> None:
    """Systematic errors below 0.03 px up to 0.7 of the pitch, as the prediction says; the width is known."""
    rng = np.random.default_rng(1)
    flat, layout = array_of_wide_spots(fwhm_px, np.zeros((1, 2)))
    found = first_settings(layout, fs.Calibration(dark=0.0), flat + rng.normal(0.0, 3.0, flat.shape))
    assert found.fwhm_px == pytest.approx(fwhm_px, rel=0.05)
    assert found.systematic_px is not None
    assert found.systematic_px < 0.03
    assert not found.doubt
    moved = rng.uniform(-1.0, 1.0, (20, 2))
    images, _ = array_of_wide_spots(fwhm_px, moved)
    slopes = fs.SlopePipeline(layout, found.settings, fs.Calibration(dark=0.0))(images.astype(np.float32))
    errors = np.stack([slopes.x, slopes.y], axis=-1) - moved[:, None]
    assert np.abs(errors - errors.mean(axis=0)).max() < 0.03
    at_edge_px = float(np.abs(errors.mean(axis=0)).max())  # the same in all frames
    assert 0.4 * at_edge_px < found.at_edge_px < max(1.5 * at_edge_px, 0.01)


@pytest.mark.slow
def test_spots_almost_as_wide_as_the_largest_window_have_settings() -> None:
    """Also of a weight 1.6 times as wide as 54 px."""
    away = np.arange(64) - 31.5 - np.array([[-90], [0], [90]])
    along = np.exp(-4 * np.log(2) * (away / 54.0) ** 2).sum(axis=0)
    images = 100 * np.outer(along, along) + np.random.default_rng(1).normal(0.0, 1.0, (2, 64, 64))
    layout = replace(fs.Layout.stacked(2, (64, 64)), pitch_px=90.0)
    found = first_settings(layout, fs.Calibration(dark=0.0), images.reshape(1, 128, 64))
    assert found.fwhm_px == pytest.approx(54, rel=0.05)
    assert found.systematic_px is not None
    assert found.systematic_px < 0.03


@pytest.mark.slow
def test_spots_wider_than_their_pitch_are_doubtful() -> None:
    flat, layout = array_of_wide_spots(10.5, np.zeros((1, 2)))
    noise = np.random.default_rng(1).normal(0.0, 3.0, flat.shape)
    assert "0.75 of the pitch" in first_settings(layout, fs.Calibration(dark=0.0), flat + noise).doubt
