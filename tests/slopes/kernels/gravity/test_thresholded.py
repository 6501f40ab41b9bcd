"""Pixels measured in rows, straight from the frame: as in lanes, whatever is in the frame."""

from __future__ import annotations

import copy
import threading
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import faintspot as fs
from faintspot.slopes.kernels.gravity.gravity import gravity_of_groups
from faintspot.slopes.kernels.gravity.thresholded import thresholded_in_rows

WINDOWS = [(8, 8), (16, 16), (6, 12), (5, 4)]
ROUNDING = 2e-5
"""Sums of up to 256 float32 numbers in another order; positions are quotients of two of them, in px."""


def sensor(window: tuple[int, int], threshold: Any, calibration: fs.Calibration) -> fs.SlopePipeline:
    layout = fs.Layout.grid((3, 5), pixels=window)
    settings = fs.Settings(estimator="thresholded", threshold_e=threshold, max_bad_fraction=0.3)
    return fs.SlopePipeline(layout, settings, calibration)


def in_lanes(pipeline: fs.SlopePipeline, frame: np.ndarray) -> fs.Slopes:
    """The same by the kernel that puts the pixels of several windows side by side."""
    prepared: Any = pipeline.plan.prepared
    other = copy.copy(pipeline)
    other.plan = copy.copy(pipeline.plan)
    changed: Any = copy.copy(prepared)
    changed.kernel, changed.tables = gravity_of_groups, prepared.tables.gathered
    other.plan.prepared = changed
    other.plan._made, other.plan._kernels = None, {}
    other._small = threading.local()
    return other(frame)


def assert_close(found: fs.Slopes, expected: fs.Slopes) -> None:
    for name in ("flags", "bad_pixels", "iterations"):
        assert np.array_equal(getattr(found, name), getattr(expected, name)), name
    for name in ("x", "y", "flux", "standard_error_x", "standard_error_y"):
        # The square of a standard error is a small difference of such sums.
        rounding = ROUNDING * (5 if name.startswith("standard_error") else 1)
        np.testing.assert_allclose(
            getattr(found, name), getattr(expected, name), rtol=rounding, atol=rounding, err_msg=name
        )
    known = np.isfinite(expected.standard_error_x)
    largest = (expected.standard_error_x * expected.standard_error_y)[known]
    away = np.abs(found.covariance_xy - expected.covariance_xy)
    assert np.all(away[known] <= 10 * ROUNDING * (1 + largest))
    assert np.all(away[~known] == 0)


@pytest.mark.parametrize("window", WINDOWS)
@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
@given(seed=st.integers(0, 2**32 - 1))
def test_as_in_lanes(window: tuple[int, int], dtype: Any, seed: int) -> None:
    rng = np.random.default_rng(seed)
    calibration = fs.Calibration(100.0, gain_e_per_adu=2.0, read_noise_e=1.0)
    pipeline = sensor(window, rng.uniform(0, 20, 15), calibration)
    assert pipeline.plan.prepared.kernel is thresholded_in_rows
    frame = rng.poisson(rng.choice([1, 30]), pipeline.layout.frame_shape) + 95
    frame = frame.astype(dtype)
    hostile = [0, 65535] if dtype == np.uint16 else [np.nan, np.inf, -np.inf, 3e38, -1e30, 0]
    for _ in range(rng.integers(0, 6)):
        row, column = (rng.integers(0, side) for side in frame.shape)
        frame[row, column] = rng.choice(hostile)
    assert_close(pipeline(frame), in_lanes(pipeline, frame))


def test_no_sub_aperture_depends_on_its_neighbours() -> None:
    pipeline = sensor((8, 8), 3.0, fs.Calibration(read_noise_e=1.0))
    frame = np.random.default_rng(1).poisson(10.0, pipeline.layout.frame_shape).astype(np.float32)
    clean = pipeline(frame)
    frame[3, 3] = np.nan
    spoilt = pipeline(frame)
    assert spoilt.bad_pixels[0] == 1
    for name in vars(clean):
        assert np.array_equal(getattr(clean, name)[1:], getattr(spoilt, name)[1:]), name


def test_images_do_not_change_slopes() -> None:
    pipeline = sensor((8, 8), 3.0, fs.Calibration(read_noise_e=1.0))
    frame = np.random.default_rng(2).poisson(10.0, pipeline.layout.frame_shape).astype(np.float32)
    plain, explained = pipeline(frame), pipeline.explain(frame)
    for name in vars(plain):
        assert np.array_equal(getattr(plain, name), getattr(explained.slopes, name)), name
    assert np.array_equal(explained.calibrated, pipeline.layout.images(frame))


def test_windows_of_odd_widths_are_measured_in_lanes() -> None:
    assert sensor((10, 10), 3.0, fs.Calibration()).plan.prepared.kernel is gravity_of_groups
