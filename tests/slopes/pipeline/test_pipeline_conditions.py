"""The pipeline under bad conditions, at every size, and against published slope errors."""

import warnings
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests import naive
from tests.pipeline_cases import FIELDS, assert_same

import faintspot as fs
from faintspot.slopes.simulate import sensor_frames

Flag = fs.SubapertureFlag


class TestBadFrames:
    """Whatever arrives: flags, no NaN, no warning, no exception."""

    layout = fs.Layout.grid((5, 5), pixels=8)
    pipeline = fs.SlopePipeline(layout, fs.Settings(noise_std=1.0))

    def measure(self, frame: Any) -> fs.Slopes:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            slopes = self.pipeline(frame)
        for field in FIELDS:
            assert np.isfinite(getattr(slopes, field)).all(), field
        unmeasured = ~slopes.measured
        assert np.all(slopes.x[unmeasured] == 0.0)
        assert np.all(slopes.y[unmeasured] == 0.0)
        return slopes

    @pytest.mark.parametrize("value", [0.0, 5.0, -3.0, 1e29, 1e-42])
    def test_constant_frames_have_no_flux(self, value: float) -> None:
        slopes = self.measure(np.full((40, 40), value, np.float32))
        assert np.all(slopes.flags == Flag.NO_FLUX | Flag.INFEASIBLE_STRENGTH)
        assert np.all(slopes.flux == 0.0)

    @pytest.mark.parametrize("dtype", [np.float32, np.float64])
    @pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 3e38])
    def test_frames_without_a_finite_pixel_are_flagged(self, value: float, dtype: Any) -> None:
        slopes = self.measure(np.full((40, 40), value, dtype))
        assert np.all(slopes.flags == Flag.TOO_MANY_BAD_PIXELS)
        assert np.all(slopes.bad_pixels == 64)

    @pytest.mark.parametrize("dtype", [np.uint16, np.float32])
    def test_masked_pixels_are_bad(self, dtype: Any) -> None:
        frame = np.random.default_rng(1).integers(0, 50, (40, 40)).astype(dtype)
        mask = np.zeros((40, 40), bool)
        mask[3, 3] = mask[10, 12] = True
        slopes = self.measure(np.ma.MaskedArray(frame, mask))
        expected = self.measure(np.where(mask, np.nan, frame))
        assert slopes.bad_pixels[0] == 1
        for name in ("x", "y", "flux", "flags", "bad_pixels"):
            np.testing.assert_array_equal(getattr(slopes, name), getattr(expected, name))

    @pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.int16, np.int32])
    def test_saturated_windows_are_flagged(self, dtype: Any) -> None:
        frame = np.random.default_rng(2).integers(0, 100, (40, 40)).astype(dtype)
        frame[2, 3] = np.iinfo(dtype).max
        slopes = self.measure(frame)
        assert slopes.flags[0] & Flag.SATURATED
        assert not np.any(slopes.flags[1:] & Flag.SATURATED)
        assert slopes.valid[0]
        full = self.measure(np.full((40, 40), np.iinfo(dtype).max, dtype))
        assert np.all(full.flags == Flag.SATURATED | Flag.NO_FLUX | Flag.INFEASIBLE_STRENGTH)

    def test_corrupt_frame_leaves_its_neighbours_alone(self) -> None:
        rng = np.random.default_rng(4)
        cube = rng.poisson(5.0, (21, 40, 40)).astype(np.float32)
        expected = self.measure(cube)
        for corrupt in (np.nan, np.inf, 0.0, 1e30, -1e38):
            damaged = cube.copy()
            damaged[10] = corrupt
            slopes = self.measure(damaged)
            assert not slopes.valid[10].any()
            assert_same(slopes, expected, np.arange(21) != 10)
        damaged = cube.copy()
        damaged[10, :8, :8] = np.nan  # one sub-aperture only
        slopes = self.measure(damaged)
        assert not slopes.valid[10, 0]
        assert_same(slopes, expected, (10, slice(1, None)))

    def test_lone_good_pixel_and_bad_corner(self) -> None:
        frame = np.random.default_rng(5).uniform(0, 50, (40, 40))
        frame[:8, :8] = np.nan
        frame[0, 0] = 7.0
        frame[0, 8] = np.nan
        slopes = self.measure(frame)
        assert slopes.bad_pixels[:3].tolist() == [63, 1, 0]
        assert slopes.flags[0] & Flag.TOO_MANY_BAD_PIXELS
        assert slopes.flags[1] & Flag.TOO_MANY_BAD_PIXELS == 0

    @given(seed=st.integers(0, 2**32 - 1))
    def test_hostile_values_equal_the_oracle(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        values = [
            0.0,
            -0.0,
            1.0,
            -1.0,
            1e-45,
            1e-38,
            1e30,
            -1e30,
            9.9e29,
            3.4e38,
            np.nan,
            np.inf,
            1e15,
            1e-20,
        ]
        chosen = rng.choice(values, rng.integers(1, 5))
        self.measure(rng.choice(chosen, (40, 40)).astype(np.float32))

    def test_nearly_flat_image_is_no_flux(self) -> None:
        frame = 1e6 + np.random.default_rng(6).normal(0, 0.01, (40, 40))
        slopes = self.measure(frame)
        assert np.all(slopes.flags & Flag.NO_FLUX)


class TestTooStrong:
    """Strengths that are too strong for the images are lowered: no slope is lost."""

    @pytest.mark.parametrize("side", [8, 16])
    @pytest.mark.parametrize("strength", [3.15, 6.0, "auto"])
    @pytest.mark.parametrize("preset", ["accurate", "fast"])
    def test_every_slope_without_denoising_is_one_with_it(
        self, side: int, strength: Any, preset: str
    ) -> None:
        camera = fs.slopes.simulate.Detector(read_noise_e=3.0)
        images, _ = fs.slopes.simulate.subapertures(
            400, shape=(side, side), flux_e=70.0, detector=camera, rng=np.random.default_rng(side)
        )
        frame = images.reshape(-1, side)
        layout = fs.Layout.stacked(400, (side, side), np.zeros((400, 2)))
        calibration = fs.Calibration(read_noise_e=3.0)
        common: Any = {"flux_e": 70.0, "spot_fwhm_px": 2.0}
        without = fs.SlopePipeline(layout, fs.Settings("brightest", **common), calibration)(frame)
        settings = fs.Settings("tv", noise_std=strength, preset=preset, **common)
        slopes = fs.SlopePipeline(layout, settings, calibration)(frame)
        assert without.valid.all()
        assert slopes.valid.all()
        lowered = (slopes.flags & Flag.INFEASIBLE_STRENGTH) > 0
        assert strength == "auto" or lowered.any()
        assert np.all(slopes.flux > 0)


class TestWindows:
    @pytest.mark.parametrize("window", [(4, 4), (64, 64), (5, 9), (9, 5), (16, 16)])
    @pytest.mark.parametrize("n", [1, 3])
    def test_windows_of_any_size_and_number_equal_the_oracle(self, window: tuple[int, int], n: int) -> None:
        layout = fs.Layout.grid((1, n), pixels=window)
        rng = np.random.default_rng(7)
        frames, truth = sensor_frames(layout, 4, flux_e=5000.0, rng=rng)
        settings = fs.Settings(noise_std=0.3, max_iterations=40)
        slopes = fs.SlopePipeline(layout, settings)(frames)
        assert slopes.valid.all()
        for frame, x, y in zip(frames, slopes.x, slopes.y, strict=True):
            expected = naive.slopes(frame, layout, settings)
            assert np.allclose(x, [e.x for e in expected], atol=1e-3)
            assert np.allclose(y, [e.y for e in expected], atol=1e-3)
        if min(window) > 4:  # there a spot's wings leave the window
            assert np.max(np.abs(np.stack([slopes.x, slopes.y], -1) - truth)) < 0.3
