from functools import partial

import numpy as np
import pytest
from tests.refusals import assert_each_refused

from faintspot.base.statistics import slope_error
from faintspot.slopes.estimators.noise import pixel_noise, suggested_strength
from faintspot.slopes.pipeline.settings import Settings
from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.simulate import Detector, sensor_frames, subapertures


def test_strength_is_read_noise_and_a_quarter_of_the_photon_noise() -> None:
    assert suggested_strength(3.0, 0.0, 256) == 3.0
    assert suggested_strength(0.0, 256.0, 256) == 0.5
    assert suggested_strength(0.0, 256.0, 256, excess_noise=2.0) == pytest.approx(np.sqrt(0.5))
    assert suggested_strength([1.0, 2.0], [[0.0], [100.0]], 100).shape == (2, 2)


def test_bad_strength_arguments() -> None:
    good = partial(suggested_strength, read_noise_e=1.0, flux_e=1.0, pixels=256)
    assert_each_refused(good, read_noise_e=[-1.0, np.nan], flux_e=[-1.0, "bright"], pixels=[0, 2.5])


def test_pixel_noise_of_normal_noise() -> None:
    """Median of 2 * 7 * 500 differences of two: its relative standard error is about 1.4 %."""
    images = np.random.default_rng(1).normal(50.0, 3.0, (500, 8, 8))
    images[:, 2:-2, 2:-2] += 1000.0
    assert pixel_noise(images) == pytest.approx(3.0, rel=0.06)
    assert pixel_noise(np.ones((3, 4, 4))) == 0.0


def test_pixel_noise_of_one_column_is_refused() -> None:
    assert_each_refused(pixel_noise, images=[np.ones((4, 1))])


def test_pixel_noise_of_several_frames_leaves_out_what_stands_still() -> None:
    still = np.random.default_rng(1).uniform(0, 1000, (1, 10, 8, 8))
    noisy = still + np.random.default_rng(2).normal(0.0, 3.0, (20, 10, 8, 8))
    # 20 frames of 160 pixels: the median absolute difference is good to about 2 %; 3 of its errors.
    assert pixel_noise(noisy) == pytest.approx(3.0, rel=0.06)


@pytest.mark.parametrize("read_noise_e", [1.0, 3.0])
@pytest.mark.parametrize("flux_e", [0.0, 100.0, 500.0])
def test_pixel_noise_under_spots(read_noise_e: float, flux_e: float) -> None:
    """Within 4 % without flux (30,000 differences: 0.7 % standard error; rounding to whole electrons).

    With light, the wings of a Nyquist-sampled spot put up to 0.3 % of the flux into a pixel at the edge; its
    photon noise and shape may raise the estimate by up to the square root of 1 + 0.003 * flux / variance.
    """
    images, _ = subapertures(
        1000, flux_e=flux_e, detector=Detector(read_noise_e), rng=np.random.default_rng(1)
    )
    noise = pixel_noise(images)
    highest = np.sqrt(1 + 0.003 * flux_e / read_noise_e**2)
    assert 0.96 * read_noise_e <= noise <= 1.04 * highest * read_noise_e


def test_pixel_noise_does_not_see_an_offset_or_a_few_hot_pixels() -> None:
    images = np.random.default_rng(2).normal(0.0, 2.0, (300, 16, 16))
    plain = pixel_noise(images)
    images[:5, 0, 3] = 1e4
    assert pixel_noise(images + 100.0) == pytest.approx(plain, rel=0.02)


@pytest.mark.slow
def test_suggested_strength_gains_and_the_full_noise_gains_less() -> None:
    """At 0.1 e- and 50 e-, k = 12, the suggested strength lowers R by more than five paired standard errors.

    The full noise of pixels (sqrt of read noise^2 + flux / pixels) is worse than the suggested strength.
    """
    layout = Layout.grid((6, 6), pixels=16)
    rng = np.random.default_rng(3)
    frames, truth = sensor_frames(layout, 100, flux_e=50.0, detector=Detector(0.1), rng=rng)

    def error(settings: Settings) -> tuple[float, float]:
        slopes = SlopePipeline(layout, settings)(frames)
        estimate = slope_error(slopes.x, slopes.y, truth)
        return estimate.value, estimate.standard_error

    suggested = float(suggested_strength(0.1, 50.0, 256))
    full = float(np.sqrt(0.1**2 + 50.0 / 256))
    plain, standard_error = error(Settings("brightest", keep_brightest=12))
    assert error(Settings(noise_std=suggested, keep_brightest=12))[0] < plain - 5 * standard_error
    assert (
        error(Settings(noise_std=suggested, keep_brightest=12))[0]
        < error(Settings(noise_std=full, keep_brightest=12))[0]
    )
