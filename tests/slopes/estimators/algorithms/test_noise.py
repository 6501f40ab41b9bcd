from functools import partial
from typing import Any

import numpy as np
import pytest
from tests.refusals import assert_each_refused, refused
from tests.slopes.estimators.algorithms.image_cases import BAD_IMAGES

from faintspot.slopes.estimators.algorithms.noise import pixel_noise, suggested_strength


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


@pytest.mark.parametrize(("bad", "words"), BAD_IMAGES)
def test_bad_images(bad: Any, words: str) -> None:
    with refused("images", words):
        pixel_noise(bad)


def test_one_column() -> None:
    with refused("images", "2 columns"):
        pixel_noise(np.ones((4, 1)))


def test_pixel_noise_of_several_frames_leaves_out_what_stands_still() -> None:
    still = np.random.default_rng(1).uniform(0, 1000, (1, 10, 8, 8))
    noisy = still + np.random.default_rng(2).normal(0.0, 3.0, (20, 10, 8, 8))
    # 20 frames of 160 pixels: the median absolute difference is good to about 2 %; 3 of its errors.
    assert pixel_noise(noisy) == pytest.approx(3.0, rel=0.06)
