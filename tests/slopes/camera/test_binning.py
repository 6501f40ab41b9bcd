"""Binned frames and their calibration."""

from typing import Any

import numpy as np

from faintspot import Calibration
from faintspot.slopes.camera.calibration import binned, binned_calibration, camera_calibration, spread


def test_sums_of_blocks_without_the_rest() -> None:
    frame = np.arange(35, dtype=np.uint16).reshape(5, 7)
    np.testing.assert_array_equal(binned(frame, 2), [[16, 24, 32], [72, 80, 88]])
    assert binned(frame[None], 2).shape == (1, 2, 3)


def test_integers_do_not_overflow() -> None:
    assert binned(np.full((2, 2), 65_535, np.uint16), 2) == 4 * 65_535


def test_saturated_and_bad_pixels_take_their_block() -> None:
    frame = np.ones((2, 6))
    frame[0, 0], frame[1, 3] = 100.0, np.nan
    sums = binned(frame, 2, saturation=100.0)
    assert sums[0, 0] >= 400
    assert np.isnan(sums[0, 1])
    assert sums[0, 2] == 4


def test_spread_keeps_the_flux() -> None:
    image = np.array([[4.0, 8.0]], np.float32)
    np.testing.assert_array_equal(spread(image, 2), [[1, 1, 2, 2], [1, 1, 2, 2]])
    np.testing.assert_array_equal(binned(spread(image, 2), 2), image)


def test_levels_and_variances_add_up() -> None:
    camera = Calibration(
        dark=100.0,
        gain_e_per_adu=0.5,
        em_gain=10.0,
        read_noise_e=3.0,
        background_e=0.2,
        saturation_adu=4000.0,
    )
    of_two = binned_calibration(camera, 2, (4, 6))
    assert of_two == Calibration(
        dark=400.0,
        gain_e_per_adu=0.5,
        em_gain=10.0,
        read_noise_e=6.0,
        background_e=0.8,
        saturation_adu=16_000.0,
    )


def test_there_and_back() -> None:
    known: dict[str, Any] = {
        "gain_e_per_adu": 0.5, "em_gain": 10.0, "read_noise_e": 3.0, "background_e": 0.2,
    }  # fmt: skip
    for dark in (100.0, np.repeat(np.repeat([[5.0, 6.0, 7.0]], 2, axis=0), 2, axis=1)):
        camera = Calibration(dark=dark, **known)
        again = camera_calibration(binned_calibration(camera, 2, (2, 6)), 2)
        np.testing.assert_allclose(again.dark, dark)
        assert {name: getattr(again, name) for name in known} == known


def test_maps_are_those_of_sums_of_pixels() -> None:
    noise, flat = np.array([[1.0, 1, 3, 4], [1, 1, 0, 0]]), np.array([[1.0, 1.2, 1, 1], [0.8, 1, 1, np.nan]])
    camera = Calibration(dark=np.full((2, 4), 7.0), flat=flat, read_noise_e=noise, bad_pixels=[[0, 3]])
    of_two = binned_calibration(camera, 2, (2, 4))
    np.testing.assert_allclose(of_two.read_noise_e, [[2, 5]])
    np.testing.assert_array_equal(of_two.dark, [[28, 28]])
    np.testing.assert_allclose(of_two.flat[0, 0], 1)
    np.testing.assert_array_equal(of_two.bad_pixels, [[False, True]])
