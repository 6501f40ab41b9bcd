"""Frames of small sensors give the same slopes one at a time as in a block."""

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest

import faintspot as fs
from faintspot.slopes.kernels.groups import SlopeArrays

LAYOUT = fs.Layout.grid((3, 3), pixels=8)


def pipeline(estimator: str = "brightest", **options: Any) -> fs.SlopePipeline:
    calibration = fs.Calibration(dark=2.0, read_noise_e=1.0, bad_pixels=[(3, 3), (12, 20)])
    return fs.SlopePipeline(LAYOUT, fs.Settings(estimator, **options), calibration)


def frame_of(kind: Any, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).poisson(8.0, LAYOUT.frame_shape).clip(0, 255).astype(kind)


def assert_same(found: fs.Slopes, block: fs.Slopes) -> None:
    for name in SlopeArrays._fields:
        one, several = getattr(found, name), getattr(block, name)
        assert one.dtype == several.dtype
        np.testing.assert_array_equal(one, several[0], err_msg=name)


@pytest.mark.parametrize("kind", ["u1", "u2", ">u2", "f4", ">f4", "f8", "i4", "?"])
@pytest.mark.parametrize("estimator", ["brightest", "tv"])
def test_every_type_of_pixels(kind: str, estimator: str) -> None:
    measure = pipeline(estimator, **({"noise_std": 1.0} if estimator == "tv" else {}))
    frame = frame_of(kind)
    assert_same(measure(frame), measure(frame[None]))


def test_pixels_that_are_not_in_order_or_not_finite_or_masked() -> None:
    measure, frame = pipeline(), frame_of(np.float32)
    frame[4, 5], frame[20, 2] = np.nan, np.inf
    assert_same(measure(frame[:, ::-1]), measure(frame[None, :, ::-1]))
    masked = np.ma.masked_greater(frame_of(np.uint16), 12)
    assert_same(measure(masked), measure(masked[None]))


def test_saturation_is_that_of_the_type() -> None:
    measure = pipeline()
    for kind in (np.uint8, np.uint16):
        frame = frame_of(kind)
        frame[1, 1] = np.iinfo(kind).max
        assert measure(frame).flags[0] & fs.SubapertureFlag.SATURATED
    assert not measure(np.minimum(frame, 255)).flags[0] & fs.SubapertureFlag.SATURATED


@pytest.mark.slow  # compiled for 4 lanes
def test_other_widths_and_stacks_do_not_share_it() -> None:
    measure, frame = pipeline(), frame_of(np.uint16)
    measure(frame)
    narrow = measure.with_width(4)
    assert_same(narrow(frame), measure(frame[None]))
    stacked = measure.for_images()
    images = np.ones(stacked.layout.frame_shape, np.float32)
    assert_same(stacked(images), stacked(images[None]))


def test_slopes_are_kept_and_threads_do_not_disturb_each_other() -> None:
    measure = pipeline()
    frames = np.array([frame_of(np.uint16, seed) for seed in range(40)])
    block = measure(frames)
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(measure, frames))
    np.testing.assert_array_equal([each.x for each in found], block.x)
    np.testing.assert_array_equal([each.flags for each in found], block.flags)
