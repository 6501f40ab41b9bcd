"""Noise of each pixel and blinking pixels of simulated cameras whose values are known."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import faintspot as fs
from faintspot.slopes.camera.dark_frames import DarkPixels, shrunk_variance, two_level_fraction
from faintspot.slopes.simulate import Detector

SHAPE = (64, 64)


def pixels_of(darks: NDArray[Any]) -> DarkPixels:
    pixels = fs.measure_detector(darks=darks).pixels
    assert pixels is not None
    return pixels


def measured(detector: Detector, n: int, shape: tuple[int, int] = SHAPE) -> DarkPixels:
    return pixels_of(detector.expose(np.zeros((n, *shape)), np.random.default_rng(2)))


def logarithmic_error(found: NDArray[Any], true: Any) -> float:
    return float(np.sqrt(np.mean(np.square(np.log(np.square(found / true))))))


class TestNoise:
    def test_is_that_of_the_camera(self) -> None:
        """Variances of 60 frames are known to sqrt(2 / 59) = 18 %."""
        detector = Detector.cmos(
            SHAPE, 1.0, gain_e_per_adu=0.5, offset_adu=90.0, rng=np.random.default_rng(1)
        )
        pixels = measured(detector, 60)
        true = np.asarray(detector.read_noise_e) / 0.5
        assert logarithmic_error(pixels.noise_adu, true) == pytest.approx(0.18, abs=0.02)
        # Of 4096 means with errors of 0.3 ADU the mean is known to 0.005.
        assert np.mean(pixels.level_adu) == pytest.approx(90.0, abs=0.02)
        assert not len(pixels.blinking)

    def test_pixels_that_do_not_differ_get_one_noise(self) -> None:
        """Ten frames give each variance to 47 %, 4096 pixels the common one to 0.7 %."""
        pixels = measured(Detector(2.0), 10)
        assert logarithmic_error(pixels.noise_adu, 2.0) < 0.03

    def test_shrinking_helps_where_frames_are_few(self) -> None:
        rng = np.random.default_rng(3)
        true = rng.lognormal(0.0, 0.4, 20_000)
        seen = true * rng.chisquare(7, true.size) / 7
        found, typical = shrunk_variance(seen, 7)
        assert logarithmic_error(np.sqrt(found), np.sqrt(true)) < 0.75 * logarithmic_error(
            np.sqrt(seen), np.sqrt(true)
        )
        assert typical == pytest.approx(1.0, rel=0.1)

    def test_noiseless_frames_have_no_noise(self) -> None:
        pixels = measured(Detector(0.0, offset_adu=5.0), 12)
        assert np.all(pixels.noise_adu == 0)
        assert not len(pixels.blinking)


class TestBlinking:
    def test_pixels_of_two_levels_are_found(self) -> None:
        """Levels six standard deviations apart, half of the frames each; no other pixel."""
        where = [(5, 6), (30, 40), (63, 0)]
        detector = Detector(
            1.0, blinking_pixels=[(*place, 6.0) for place in where], bits=12, offset_adu=100.0
        )
        assert measured(detector, 80).blinking.tolist() == [list(place) for place in where]

    def test_noisy_pixels_do_not_blink(self) -> None:
        detector = Detector.cmos((200, 200), 1.0, spread=1.0, rng=np.random.default_rng(5))
        assert not len(measured(detector, 60, (200, 200)).blinking)

    def test_one_cosmic_ray_is_no_level(self) -> None:
        darks = np.random.default_rng(7).normal(0.0, 1.0, (40, *SHAPE))
        darks[11, 3, 4] += 500.0
        assert not len(pixels_of(darks).blinking)

    def test_what_two_levels_leave(self) -> None:
        """Nothing of two levels without noise, and 1 - 2 / pi of many normal values."""
        two = np.tile([[0.0], [3.0]], (50, 1))
        assert two_level_fraction(two)[0] == pytest.approx(0.0, abs=1e-12)
        normal = np.random.default_rng(8).standard_normal((20_000, 1))
        assert two_level_fraction(normal)[0] == pytest.approx(1 - 2 / np.pi, abs=0.01)

    def test_hot_pixels_are_found(self) -> None:
        detector = Detector(1.0, hot_pixels=[(9, 9, 400.0)])
        assert measured(detector, 30).hot.tolist() == [[9, 9]]
