import math
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from tests.refusals import assert_each_refused, refused

import faintspot as fs


class TestMaps:
    def test_default_is_electrons(self) -> None:
        maps = fs.Calibration().maps((3, 4))
        assert maps.dtype == np.float32
        assert np.array_equal(maps, [np.zeros((3, 4)), np.ones((3, 4))])

    def test_electrons_per_adu(self) -> None:
        flat = np.linspace(0.5, 2.0, 12).reshape(3, 4)
        dark = np.arange(12.0).reshape(3, 4)
        calibration = fs.Calibration(dark, flat, gain_e_per_adu=20.0, em_gain=500.0)
        maps = calibration.maps((3, 4))
        assert np.array_equal(maps[0], dark)
        assert np.allclose(maps[1], 20.0 / (500.0 * flat), rtol=1e-6)

    def test_bad_pixels_become_nan_in_the_maps(self) -> None:
        flat = np.ones((3, 4))
        flat[0] = [0.0, -1.0, np.nan, np.inf]
        dark = np.zeros((3, 4))
        dark[1, 1] = np.nan
        expected = np.zeros((3, 4), bool)
        expected[0] = expected[1, 1] = True
        assert np.array_equal(np.isnan(fs.Calibration(dark, flat).maps((3, 4)).sum(axis=0)), expected)
        mask = np.zeros((3, 4), bool)
        mask[2, 3] = mask[0, 1] = True
        narrow = np.array([[True, False], [False, False], [True, False]])  # as wide as a list of pixels
        assert np.array_equal(np.isnan(fs.Calibration(bad_pixels=narrow).maps((3, 2))[1]), narrow)
        for bad in (mask, [[2, 3], [0, 1]], [[2, 3], [0, 1], [2, 3]], np.argwhere(mask)):
            assert np.array_equal(np.isnan(fs.Calibration(bad_pixels=bad).maps((3, 4))[1]), mask)
        assert not np.isnan(fs.Calibration(bad_pixels=[]).maps((3, 4))).any()

    def test_values_beyond_float32_are_bad_pixels(self) -> None:
        dark, flat = np.zeros((2, 2)), np.ones((2, 2))
        dark[0, 0], flat[0, 1], flat[1, 0] = 1e300, 1e-100, 5e-324
        maps = fs.Calibration(dark, flat).maps((2, 2))
        assert np.array_equal(np.isfinite(maps).all(axis=0), [[False, False], [False, True]])

    def test_saturation_is_stated_or_that_of_the_type(self) -> None:
        assert fs.Calibration().saturation(np.dtype("u2")) == 65535
        assert fs.Calibration().saturation(np.dtype(">i2")) == 32767
        assert not np.inf >= fs.Calibration().saturation(np.dtype("f4"))
        assert fs.Calibration(saturation_adu=4000).saturation(np.dtype("u2")) == 4000.0
        assert fs.Calibration(saturation_adu=4000).saturation(np.dtype("f4")) == 4000.0


def test_is_immutable_and_private() -> None:
    dark, bad = np.zeros((3, 4)), np.zeros((3, 4), bool)
    calibration = fs.Calibration(dark, bad_pixels=bad)
    dark[0, 0], bad[0, 0] = 5.0, True
    assert calibration.dark[0, 0] == 0.0
    assert not calibration.bad_pixels[0, 0]
    for array in (calibration.dark, calibration.bad_pixels):
        with pytest.raises(ValueError, match="read-only"):
            array[0, 0] = 1


def test_dark_is_known_if_it_is_stated_and_not_estimated() -> None:
    assert not fs.Calibration().dark_is_known
    assert fs.Calibration(dark=0.0).dark_is_known
    assert not fs.Calibration(dark=70.0, estimated=("dark",)).dark_is_known


def test_calibrations_are_equal_if_all_their_parts_are() -> None:
    dark = np.full((3, 4), np.nan)
    assert fs.Calibration(dark) == fs.Calibration(dark.copy())
    assert fs.Calibration(dark) != fs.Calibration()
    assert fs.Calibration() != fs.Calibration(flat=np.ones((3, 4)))
    assert fs.Calibration(em_gain=2.0) != fs.Calibration()
    assert fs.Calibration() != 1


def test_calibrations_out_of_range_are_refused() -> None:
    map_, other = np.zeros((3, 4)), np.ones((4, 3))
    noise = [np.array([[1.0, -1.0], [np.nan, 1.0]]), np.full((3, 4), np.nan), np.full((3, 4), np.inf)]
    assert_each_refused(
        fs.Calibration,
        dark=[np.zeros(3), np.nan, "dark.fits", np.zeros((2, 3, 4)), [[1, True]]],
        estimated=["dark", ["flat"]],
        flat=["flat.fits", np.ones((3, 4), complex)],
        gain_e_per_adu=[np.ones((3, 4))],
        bad_pixels=[[1, 2], [[-1, 0]], [[0.5, 0]], [[1, 2, 3]], "hot", [[1, 2], [3]], np.zeros(3, bool)],
        read_noise_e=[*noise, np.ones(4)],
    )
    assert_each_refused(
        partial(fs.Calibration, dark=map_),
        flat=[other],
        read_noise_e=[other],
        bad_pixels=[np.zeros((3, 3), bool)],
    )


def test_maps_of_another_frame() -> None:
    with refused("calibration.flat", "(5, 5)", "(3, 4)"):
        fs.Calibration(flat=np.ones((3, 4))).maps((5, 5))
    with refused("calibration.read_noise_e", "(5, 5)", "(3, 4)"):
        fs.Calibration(read_noise_e=np.ones((3, 4))).maps((5, 5))
    with refused("calibration.bad_pixels", "(3, 0) is outside (3, 4)"):
        fs.Calibration(bad_pixels=[[0, 0], [3, 0]]).maps((3, 4))


class TestNoiseMap:
    def test_bad_pixels_have_no_noise(self) -> None:
        """NaN in the map marks a bad pixel, and bad pixels of other maps are NaN in what the map gives."""
        noise = np.full((3, 4), 6.0)
        noise[0, 1] = np.nan
        calibration = fs.Calibration(em_gain=2.0, bad_pixels=[[2, 3]], read_noise_e=noise)
        expected = np.full((3, 4), 3.0)
        expected[0, 1] = expected[2, 3] = np.nan
        np.testing.assert_array_equal(calibration.read_noise_map((3, 4)), expected)
        np.testing.assert_array_equal(np.isnan(calibration.maps((3, 4))[1]), np.isnan(expected))
        assert fs.Calibration(read_noise_e=6.0).read_noise_map((3, 4)) is None

    def test_typical_is_the_root_mean_square(self) -> None:
        calibration = fs.Calibration(em_gain=5.0, read_noise_e=np.array([[3.0, 4.0], [5.0, np.nan]]))
        assert calibration.typical_read_noise_e == pytest.approx(math.sqrt(50 / 3))
        assert calibration.read_noise_photoelectrons == pytest.approx(math.sqrt(2 / 3))

    def test_is_stored_beside_the_file(self, tmp_path: Path) -> None:
        noise = np.random.default_rng(1).lognormal(0.0, 0.5, (3, 4))
        calibration = fs.Calibration(read_noise_e=noise)
        calibration.save(tmp_path / "faintspot.toml")
        assert fs.Calibration.load(tmp_path / "faintspot.toml") == calibration

    def test_is_read_from_a_file_that_is_named(self, tmp_path: Path) -> None:
        np.save(tmp_path / "noise.npy", np.ones((3, 4)))
        np.save(tmp_path / "cube.npy", np.ones((2, 3, 4)))
        table = tmp_path / "faintspot.toml"
        table.write_text('[calibration]\nread_noise_e = "noise.npy"\n', encoding="utf-8")
        assert fs.Calibration.load(table) == fs.Calibration(read_noise_e=np.ones((3, 4)))
        table.write_text('[calibration]\nread_noise_e = "cube.npy"\n', encoding="utf-8")
        with refused("cube.npy", "one map"):
            fs.Calibration.load(table)
