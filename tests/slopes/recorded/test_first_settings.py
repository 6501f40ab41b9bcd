"""Settings to begin with: not worse than a fixed window, on spots they were not chosen on."""

import numpy as np
import pytest
from numpy.typing import NDArray

import faintspot as fs
from faintspot.slopes.recorded.first_settings import first_settings

N = 60


def frames(flux_e: float, read_noise_e: float, side: int, seed: int) -> tuple[NDArray[np.float32], fs.Layout]:
    """Three frames of stacked windows; spots of FWHM 3.6 px within 1.5 px."""
    images, _ = simulated(flux_e, read_noise_e, side, seed)
    return images, fs.Layout.stacked(N, (side, side))


def simulated(
    flux_e: float, read_noise_e: float, side: int, seed: int
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
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


@pytest.mark.parametrize(
    ("flux_e", "read_noise_e"), [(50, 0.1), (200, 3.0), (2000, 3.0), (40, 3.0), (10, 3.0)]
)
def test_not_worse_than_a_fixed_window_or_the_reference(flux_e: float, read_noise_e: float) -> None:
    """At most 5 % worse, which is three standard errors of 360 slopes that share their images."""
    side = 27
    shown, layout = frames(flux_e, read_noise_e, side, 1)
    found = first_settings(layout, fs.Calibration(dark=0.0), shown)
    assert found.noise == pytest.approx(read_noise_e, rel=0.15)
    assert (found.response < 1) == (flux_e <= 40)
    images, truth = simulated(flux_e, read_noise_e, side, 2)
    window = fs.Settings("window", spot_fwhm_px=3.6, flux_e=flux_e)
    reached = error(found.settings, layout, images, truth)
    assert reached < 1.05 * error(window, layout, images, truth)
    assert reached < 1.05 * float(np.abs(truth).mean())


@pytest.mark.parametrize("range_px", [0.0, 1.0, 3.0])
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


def test_no_spots() -> None:
    """The reference is the best answer."""
    noise = np.random.default_rng(1).normal(0.0, 3.0, (1, N * 16, 16))
    layout = fs.Layout.stacked(N, (16, 16))
    found = first_settings(layout, fs.Calibration(dark=0.0), noise)
    assert found.response < 0.2
    assert error(found.settings, layout, noise.astype(np.float32), np.zeros((1, N, 2))) < 0.2
