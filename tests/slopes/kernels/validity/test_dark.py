"""Windows without flux are found from their pixels in bright frames, and in means of frames."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from tests import naive
from tests.patience import examples

import faintspot as fs
from faintspot import SubapertureFlag as Flag

SIDE = 12
LAYOUT = fs.Layout.grid((9, 9), pixels=SIDE, outer_radius=4.5)
N = len(LAYOUT)
WEIGHTED = fs.Settings("weighted", weight_fwhm_px=3.0, spot_fwhm_px=2.0)


def frames_of(flux_e: Any, n: int, seed: int = 1, noise: float = 3.0) -> NDArray[np.float32]:
    rng = np.random.default_rng(seed)
    images = fs.PSF.analytic("gaussian").images(np.zeros((N, 2)), (SIDE, SIDE), np.broadcast_to(flux_e, N))
    mean = np.zeros(LAYOUT.frame_shape)
    for (row, column), image in zip(LAYOUT.corners, images, strict=True):
        mean[row : row + SIDE, column : column + SIDE] += image
    size = (n, *mean.shape)
    return (rng.poisson(mean, size) + 100.0 + noise * rng.standard_normal(size)).astype(np.float32)


def some_dark(flux_e: float) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    dark = np.random.default_rng(2).random(N) < 0.2
    return np.where(dark, 0.0, flux_e), dark


def no_flux(slopes: fs.Slopes) -> NDArray[np.bool_]:
    return np.asarray((slopes.flags & Flag.NO_FLUX) != 0)


class TestAgainstOracle:
    @given(seed=st.integers(0, 2**32 - 1))
    @examples(6)
    def test_random_and_hostile_frames(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        window = int(rng.integers(3, 21)), int(rng.integers(3, 21))
        rows, columns = (int(n) for n in rng.integers(1, 9, 2))
        layout = fs.Layout.grid((rows, columns), pixels=window, frame_shape=(170, 170))
        n, fwhm = len(layout), float(rng.choice([1.5, 2.5, 5.0]))
        frame = rng.normal(100.0, rng.choice([0.0, 1.0, 4.0]), layout.frame_shape)
        y, x = np.mgrid[:170, :170]
        for centre in layout.centres[rng.random(n) < 0.8]:
            spot = np.exp(-((x - centre[0]) ** 2 + (y - centre[1]) ** 2) * 2.77 / fwhm**2)
            frame += rng.choice([0.0, 30.0, 300.0]) * spot
        kind = rng.choice(["<f4", "<u2"]) if window[1] >= 8 else "<f4"  # fewer kernels are compiled
        if kind == "<f4":
            for value in (np.nan, np.inf, -3e4, 1e30):
                frame[rng.random(frame.shape) < rng.choice([0.0, 0.003])] = value
        bad = rng.random(frame.shape) < rng.choice([0.0, 0.05, 0.6])
        calibration = fs.Calibration(dark=90.0, gain_e_per_adu=2.0, bad_pixels=bad)
        settings = fs.Settings("centroid", spot_fwhm_px=fwhm, max_bad_fraction=0.5)
        pipeline = fs.SlopePipeline(layout, settings, calibration)
        checked = pipeline(frame.astype(kind))
        pipeline.light_test = pipeline.light_test._replace(box=0)
        pipeline._small.__dict__.clear()
        plain = pipeline(frame.astype(kind))
        known = frame.astype(kind), layout, calibration, fwhm
        light = naive.light(*known, plain.flux, plain.measured)
        sure = ~light.unsure
        assert np.array_equal((no_flux(checked) & ~no_flux(plain))[sure], light.dark[sure])
        for name in ("x", "y", "flux"):
            kept = getattr(checked, name)[checked.measured]
            assert np.array_equal(kept, getattr(plain, name)[checked.measured])
        dark = no_flux(checked) & ~no_flux(plain)
        assert not checked.vector.reshape(2, -1)[:, dark].any()
        assert np.isinf(checked.standard_error_x[dark]).all()
        assert not checked.covariance_xy[dark].any()


@pytest.mark.parametrize("estimator", ["weighted", "brightest", "centroid", "tv"])
def test_bright_frames_show_which_are_dark(estimator: str) -> None:
    flux_e, dark = some_dark(3000.0)
    options = {"tv": {"noise_std": 3.0}}.get(estimator, {})
    settings = fs.Settings(estimator, spot_fwhm_px=2.0, **options)
    slopes = fs.SlopePipeline(LAYOUT, settings, fs.Calibration(dark=100.0))(frames_of(flux_e, 20))
    assert no_flux(slopes)[:, dark].mean() > 0.99
    assert not no_flux(slopes)[:, ~dark].any()


def test_faint_frames_decide_nothing() -> None:
    frames = frames_of(20.0, 50)
    settings = fs.Settings("window", flux_e=20.0, spot_fwhm_px=2.0)
    slopes = fs.SlopePipeline(LAYOUT, settings, fs.Calibration(dark=100.0))(frames)
    assert slopes.measured.all()
    assert slopes.valid.mean() > 0.998


def test_neither_dark_level_nor_gain_is_needed() -> None:
    flux_e, dark = some_dark(3000.0)
    frames = frames_of(flux_e, 5)
    plain = no_flux(fs.SlopePipeline(LAYOUT, WEIGHTED)(frames))
    other = no_flux(fs.SlopePipeline(LAYOUT, WEIGHTED, fs.Calibration(gain_e_per_adu=3.0))(frames))
    assert plain[:, dark].mean() > 0.99
    assert np.array_equal(plain, other)


class TestMeans:
    @pytest.mark.slow
    def test_windows_of_noise_pass_once_in_a_thousand_times(self) -> None:
        """At most: the limit allows for every pixel of the window, and two boxes."""
        passed = 0
        for seed in range(30):
            pipeline = fs.SlopePipeline(LAYOUT, WEIGHTED).with_dark(frames_of(0.0, 1, seed)[0])
            passed += N - len(pipeline.light_test.dark)
        assert passed <= 0.003 * 30 * N

    def test_recorded_noise_is_dark(self) -> None:
        frames = frames_of(0.0, 20)
        slopes = fs.SlopePipeline(LAYOUT, WEIGHTED).with_dark(frames.mean(axis=0))(frames)
        assert slopes.valid.mean() < 0.01
        assert not slopes.vector[np.tile(~slopes.valid, 2)].any()

    def test_a_faint_star_keeps_every_subaperture(self) -> None:
        frames = frames_of(20.0, 300)
        pipeline = fs.SlopePipeline(LAYOUT, fs.Settings("window", flux_e=20.0, spot_fwhm_px=2.0))
        before, after = pipeline(frames), pipeline.with_dark(frames.mean(axis=0))(frames)
        assert np.array_equal(before.vector, after.vector)
        assert not no_flux(after).any()

    def test_single_frames_have_them_although_others_were_measured_before(self) -> None:
        flux_e, dark = some_dark(300.0)
        pipeline = fs.SlopePipeline(LAYOUT, fs.Settings("brightest", keep_brightest=9))
        lit = frames_of(300.0, 1)
        assert pipeline(lit[0]).valid.all()
        found = pipeline.with_dark(frames_of(flux_e, 20).mean(axis=0))
        assert np.array_equal(no_flux(found(lit[0])), dark)
        assert np.array_equal(no_flux(found(lit))[0], dark)

    def test_small_windows_are_not_tested(self) -> None:
        layout = fs.Layout.grid((3, 3), pixels=2)
        pipeline = fs.SlopePipeline(layout, fs.Settings("centroid"))
        assert pipeline.with_dark(np.zeros(layout.frame_shape)).light_test.dark.size == 0
