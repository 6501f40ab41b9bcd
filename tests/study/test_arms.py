"""What the arms do to the images, against the public functions and SciPy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, median_filter

import faintspot as fs
from faintspot.study.arms import error_table, median_of_nine, position_table
from faintspot.study.sweep import Cell

CELL = Cell(100.0, 1.0, "diffraction", 1.0, 1.0, 10, 1.0, 0.0, 1.0)
NAN = float("nan")


@pytest.fixture(scope="module")
def simulated() -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    detector = fs.simulate.Detector(read_noise_e=1.0)
    return fs.simulate.subapertures(
        60, shape=(10, 10), flux_e=100.0, detector=detector, rng=np.random.default_rng(3)
    )


def errors(positions: NDArray[np.floating], truth: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.abs(positions - truth).mean(axis=1)  # type: ignore[no-any-return]


@pytest.mark.parametrize(
    ("arm", "candidate", "rule"),
    [
        ("plain", NAN, "subtract_next"),
        ("threshold", NAN, "threshold"),
        ("tv", 0.7, "subtract_next"),
        ("gaussian", 0.8, "subtract_next"),
        ("median", NAN, "subtract_next"),
    ],
)
def test_arms_are_what_they_say(
    simulated: tuple[NDArray[np.float32], NDArray[np.float64]], arm: str, candidate: float, rule: str
) -> None:
    images, truth = simulated
    prepared = {
        "tv": lambda: fs.tv_denoise(images, 0.7 * CELL.pixel_noise_e),
        "gaussian": lambda: np.stack([gaussian_filter(i, 0.8, mode="constant") for i in images]),
        "median": lambda: np.stack([median_filter(i, 3, mode="nearest") for i in images]),
    }.get(arm, lambda: images)()
    table, valid = error_table(arm, candidate, CELL, images, truth)
    assert table.shape == valid.shape == (60, 99)
    assert valid[:, 6:].all()  # the largest medians often tie, so that few kept pixels may leave nothing
    for k in (1, 7, 30, 99):
        kept = fs.brightest_pixels(prepared.astype(np.float64), keep=k, rule=rule)
        expected = errors(fs.centre_of_gravity(kept), truth)
        np.testing.assert_allclose(table[:, k - 1], expected, rtol=0, atol=1e-5)  # of single precision


def test_thresholded(simulated: tuple[NDArray[np.float32], NDArray[np.float64]]) -> None:
    images, truth = simulated
    table, valid = error_table("thresholded", 2.0, CELL, images, truth)
    above = np.maximum(images - 2.0 * CELL.pixel_noise_e, 0.0)
    assert table.shape == (60, 1)
    assert valid.all()
    np.testing.assert_allclose(table[:, 0], errors(fs.centre_of_gravity(above), truth), atol=1e-5)


@pytest.mark.parametrize(("arm", "candidate"), [("tv", 1.0), ("thresholded", 5.0)])
def test_without_light_the_position_is_the_centre(arm: str, candidate: float) -> None:
    truth = np.array([[0.5, -0.25]])
    noise = np.random.default_rng(4).normal(scale=0.1, size=(1, 10, 10)).astype(np.float32)
    table, valid = error_table(arm, candidate, CELL, noise, truth)
    assert not valid.any()
    np.testing.assert_allclose(table, 0.375, rtol=1e-6)


@pytest.mark.parametrize("arm", ["plain", "thresholded"])
@pytest.mark.parametrize("search_range_px", [math.inf, 0.3])
def test_errors_are_those_of_the_positions(
    simulated: tuple[NDArray[np.float32], NDArray[np.float64]], arm: str, search_range_px: float
) -> None:
    images, truth = simulated
    positions, valid = position_table(arm, 1.0, CELL, images, search_range_px)
    table, also_valid = error_table(arm, 1.0, CELL, images, truth, search_range_px)
    assert np.abs(positions).max() <= np.float32(
        search_range_px
    )  # of which "thresholded" has only single precision
    found = np.abs(positions - truth[:, None]).mean(axis=2).astype(np.float32)
    np.testing.assert_array_equal(found, table)
    np.testing.assert_array_equal(valid, also_valid)


def test_median_is_exact() -> None:
    images = np.random.default_rng(5).normal(size=(20, 6, 9)).astype(np.float32)
    expected = median_filter(images, size=(1, 3, 3), mode="nearest")
    np.testing.assert_array_equal(median_of_nine(images), expected)
