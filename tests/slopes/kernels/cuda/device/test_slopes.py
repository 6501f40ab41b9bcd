from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from tests.estimator_cases import settings_of
from tests.pipeline_cases import assert_equals_oracle, assert_same
from tests.slopes.kernels.cuda.device.cases import Flag, assert_near, small_case

import faintspot as fs
from faintspot.slopes.kernels.cuda.availability import simulated

SENSORS = [
    ((4, 4), "uint16"),
    ((4, 4), "float32"),
    ((5, 7), "uint16"),
    ((5, 7), "float32"),
    ((8, 8), "uint16"),
    ((10, 10), "float32"),
    ((16, 16), "uint16"),
    ((20, 20), "float32"),
]


def on_gpu(case: Any) -> fs.Slopes:
    return case.pipeline(device="cuda")(case.frame)  # type: ignore[no-any-return]


@pytest.mark.parametrize(("window", "dtype"), SENSORS)
def test_random_sensors(window: tuple[int, int], dtype: str) -> None:
    """Settings, rules, iteration limits and bad pixels of every sub-aperture of its own."""
    for seed in range(2 if window[0] < 8 else 1):
        denoised = {"rule": "subtract_next", "noise_std": 0.8} if window[0] >= 8 else {}
        case = small_case(seed, dtype, window, columns=2, **denoised)
        found = on_gpu(case)
        assert_near(case, found, case.pipeline()(case.frame))
        assert_equals_oracle(case, found)


@pytest.mark.parametrize("algorithm", ["fgp", "chambolle"])
@pytest.mark.parametrize("rule", ["subtract_next", "subtract_kth", "threshold"])
def test_algorithms_and_rules(algorithm: str, rule: str) -> None:
    fixed: dict[str, Any] = {"algorithm": algorithm, "rule": rule, "keep_brightest": 7}
    case = small_case(3, "uint16", (6, 8), noise_std=2.5, tolerance=1e-2, max_iterations=15, **fixed)
    # "threshold" is not continuous in the image: no equal pixels here, and none that is bad.
    case = replace(case, calibration=fs.Calibration(dark=20.0, read_noise_e=2.5, saturation_adu=1e6))
    case.frame = np.minimum(case.frame, 1000)
    assert_near(case, on_gpu(case), case.pipeline()(case.frame))


@pytest.mark.parametrize(
    ("window", "algorithm"), [((5, 7), "fgp"), ((5, 7), "chambolle"), ((8, 8), "fgp"), ((16, 16), "fgp")]
)
def test_preset_fast(window: tuple[int, int], algorithm: str) -> None:
    """The denoising begins where the CPU's does; a strength near the image's own rms, where it matters."""
    rng = np.random.default_rng(4)
    layout = fs.Layout.grid((1, 2), pixels=window)
    frame = np.concatenate(
        list(fs.slopes.simulate.subapertures(2, shape=window, flux_e=60, rng=rng)[0]), axis=1
    )
    frame += rng.normal(0.0, 1.0, frame.shape).astype(np.float32)
    settings = fs.Settings(noise_std=[1.0, 0.6], keep_brightest=12, preset="fast", algorithm=algorithm)
    expected = fs.SlopePipeline(layout, settings)(frame)
    found = fs.SlopePipeline(layout, settings, device="cuda")(frame)
    assert np.all(found.iterations == 8)
    assert np.array_equal(found.flags, expected.flags)
    assert np.abs(found.vector - expected.vector).max() < 1e-5
    assert np.allclose(found.flux, expected.flux, rtol=1e-5)


@pytest.mark.parametrize("estimator", ["brightest", "centroid", "smoothed", "thresholded"])
def test_estimators(estimator: str) -> None:
    layout = fs.Layout.grid((1, 3), pixels=(7, 9))
    frame = np.random.default_rng(5).poisson(4.0, layout.frame_shape).astype(np.uint16)
    frame[2:5, 3:6] += np.uint16(20)
    frame[3, 11:13] += np.uint16(40)
    settings = settings_of(
        estimator, keep_brightest=9, smoothing_px=[0.6, 0.9, 0.6], threshold_e=5.0, search_range_px=0.4
    )
    calibration = fs.Calibration(read_noise_e=1.0, bad_pixels=np.array([[0, 0], [3, 4], [3, 5]]))
    reference = np.array([[0.1, -0.2], [0.0, 0.3], [0.2, 0.2]])
    expected = fs.SlopePipeline(layout, settings, calibration, reference)(frame)
    found = fs.SlopePipeline(layout, settings, calibration, reference, device="cuda")(frame)
    for name in ("flags", "bad_pixels", "iterations"):
        assert np.array_equal(getattr(found, name), getattr(expected, name)), name
    for name in ("x", "y", "flux", "standard_error_x", "standard_error_y"):
        assert np.allclose(getattr(found, name), getattr(expected, name), rtol=1e-5, atol=1e-5), name


def hostile_images() -> np.ndarray[Any, Any]:
    rng = np.random.default_rng(8)
    noise = rng.normal(0.0, 1.0, (4, 5))
    one_bad, most_bad = noise.copy(), np.full((4, 5), np.nan)
    one_bad[0, 0], most_bad[1, 1] = np.nan, 3.0
    ties = np.repeat([[0.0, 1.0, 1.0, 2.0, 2.0]], 4, axis=0)
    single = np.zeros((4, 5))
    single[2, 3] = 7.0
    infinite = noise.copy()
    infinite[3, :2] = np.inf, -np.inf
    return np.stack(
        [
            np.zeros((4, 5)),  # constant
            np.full((4, 5), 5.0),
            np.full((4, 5), np.nan),
            np.full((4, 5), np.inf),
            one_bad,
            most_bad,
            infinite,
            ties,
            single,
            -single,
            1e30 * single / 7,
            1e31 * single,  # too large to be a pixel
            1e-30 * noise,
            1e-35 * noise,  # below 1e-38 the CPU takes numbers as 0
            3.0 + 1e-6 * noise,
            0.1 * noise,  # infeasible
        ]
    )


@pytest.mark.parametrize("strength", [0.0, 0.5])
def test_hostile_images(strength: float) -> None:
    images = hostile_images()
    frame = np.concatenate(images, axis=1)
    layout = fs.Layout.grid((1, len(images)), pixels=(4, 5))
    settings = fs.Settings(noise_std=strength, keep_brightest=4, max_bad_fraction=0.9, max_iterations=6)
    calibration = fs.Calibration(read_noise_e=1.0, saturation_adu=6.9)
    expected = fs.SlopePipeline(layout, settings, calibration)(frame)
    found = fs.SlopePipeline(layout, settings, calibration, device="cuda")(frame)
    for name in ("flags", "bad_pixels", "iterations"):
        assert np.array_equal(getattr(found, name), getattr(expected, name)), name
    for name in ("x", "y", "flux", "standard_error_x", "standard_error_y"):
        left, right = getattr(found, name), getattr(expected, name)
        assert not np.any(np.isnan(left))
        assert np.allclose(left, right, rtol=1e-4, atol=1e-5), name
    assert np.any(found.flags & Flag.TOO_MANY_BAD_PIXELS)
    assert np.any(found.flags & Flag.SATURATED)
    assert np.any(found.flags & Flag.INFEASIBLE_STRENGTH) == (strength > 0)


def test_automatic_settings_follow_the_flux_of_each_frame() -> None:
    layout = fs.Layout.grid((1, 2), pixels=6)
    rng = np.random.default_rng(2)
    y, x = np.mgrid[:6, :12]
    spots = np.exp(-((x % 6 - 2.5) ** 2 + (y - 2.5) ** 2) / 2)
    frames = rng.poisson(np.array([3.0, 40.0])[:, None, None] * spots).astype(np.uint16)
    settings = fs.Settings(noise_std="auto", keep_brightest="auto", spot_fwhm_px=2.4, max_iterations=8)
    calibration = fs.Calibration(read_noise_e=0.5)
    expected = fs.SlopePipeline(layout, settings, calibration)(frames)
    pipeline = fs.SlopePipeline(layout, settings, calibration, device="cuda")
    found = pipeline(frames)
    assert pipeline.needs_flux
    assert found.x.shape == (2, 2)
    assert np.array_equal(found.iterations, expected.iterations)
    assert np.allclose(found.vector, expected.vector, atol=1e-5)
    assert np.allclose(found.flux, expected.flux, rtol=1e-5)
    again = pipeline.with_width(4)(frames[::-1])
    assert np.array_equal(again.x, found.x[::-1])


@pytest.mark.parametrize("warps", [1] if simulated() else [1, 2, 4])  # the simulator's warps are blocks
def test_slopes_do_not_depend_on_the_launch(warps: int, monkeypatch: pytest.MonkeyPatch) -> None:
    from faintspot.slopes.kernels.cuda import fused
    from faintspot.slopes.pipeline import device as measuring

    case = small_case(2, "uint16", (5, 6))
    expected = on_gpu(case)
    monkeypatch.setattr(measuring, "WARPS", warps)
    monkeypatch.setattr(measuring, "slopes_kernel", partial(fused.slopes_kernel, warps=warps))
    assert_same(on_gpu(case), expected)


def test_explain_works() -> None:
    case = small_case(1, "float32", (4, 5))
    stages = case.pipeline(device="cuda").explain(case.frame)
    assert np.array_equal(stages.denoised, case.pipeline().explain(case.frame).denoised)


def test_other_estimators_are_refused() -> None:
    layout = fs.Layout.grid((1, 2), pixels=8)
    settings = fs.Settings(estimator="weighted", spot_fwhm_px=2.0)
    with pytest.raises(fs.InputError, match=r"estimator = 'weighted': device=.cuda. runs 'brightest', 'tv'"):
        fs.SlopePipeline(layout, settings, device="cuda")


def test_too_large_windows_are_refused() -> None:
    layout = fs.Layout.grid((1, 1), pixels=(8, 40))
    with pytest.raises(fs.InputError, match="at most 32 columns"):
        fs.SlopePipeline(layout, fs.Settings(noise_std=1.0), device="cuda")


def test_too_large_frames_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    from faintspot.slopes.pipeline import device as measuring

    monkeypatch.setattr(measuring, "MOST_FRAME_PIXELS", 100)
    with pytest.raises(fs.InputError, match='frame of 8 x 16 pixels: device="cuda" takes at most 100'):
        fs.SlopePipeline(fs.Layout.grid((1, 2), pixels=8), fs.Settings(noise_std=1.0), device="cuda")
