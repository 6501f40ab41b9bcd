from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests import naive
from tests.refusals import refused
from tests.slopes.estimators.algorithms.image_cases import BAD_IMAGES, images

import faintspot as fs

RULES = ("subtract_next", "threshold", "subtract_kth")
every_rule = pytest.mark.parametrize("rule", RULES)
every_dtype = pytest.mark.parametrize("dtype", [np.float32, np.float64])


@every_dtype
@every_rule
@given(images(), st.floats(0.0, 1.0))
def test_equals_sorting(rule: str, dtype: Any, stack: Any, fraction: float) -> None:
    """Exactly: the threshold is a pixel value, and one subtraction rounds the same everywhere."""
    stack = stack.astype(dtype)
    pixels = stack[0].size
    most = pixels - (rule == "subtract_next")
    keep = 1 + round(fraction * (most - 1))
    result = fs.brightest_pixels(stack, keep, rule=rule)
    assert result.dtype == dtype
    assert np.array_equal(result, [naive.brightest_pixels(g, keep, rule) for g in stack])


@every_rule
def test_every_number_of_pixels(rule: str) -> None:
    rng = np.random.default_rng(1)
    g = rng.normal(size=(4, 5)).astype(np.float32)
    ties = rng.integers(0, 4, (4, 5)).astype(np.float32)
    for keep in range(1, 20 + (rule != "subtract_next")):
        for image in (g, ties, np.abs(g) * np.float32(1e-44), g * np.float32(1e30 / 4)):
            expected = naive.brightest_pixels(image, keep, rule)
            assert np.array_equal(fs.brightest_pixels(image, keep, rule=rule), expected)


@every_dtype
@pytest.mark.parametrize("keep", [1, 7, 40, 128, 254])
def test_ties_and_outliers(keep: int, dtype: Any) -> None:
    """What stalls a search for the threshold by means: equal pixels, means that outliers spoil."""
    rng = np.random.default_rng(5)
    images = rng.poisson(2.0, (48, 16, 16)).astype(dtype) * dtype(0.7)
    images[::3, 3:5, ::7] = 1e29
    images[1::3, 5, ::5] = -1e29
    images[::5] += rng.normal(size=images[::5].shape).astype(dtype)
    images[7], images[8, 2:] = dtype(0.3), dtype(0.0)
    images[9] = np.nextafter(dtype(1.0), images[9])
    result = fs.brightest_pixels(images, keep)
    assert np.array_equal(result, [naive.brightest_pixels(g, keep) for g in images])


@every_rule
def test_one_number_per_image_and_leading_shapes(rule: str) -> None:
    g = np.random.default_rng(2).normal(size=(3, 4, 5, 6))
    keep = np.array([1, 7, 20, 29])
    together = fs.brightest_pixels(g, keep, rule=rule)
    assert together.shape == g.shape
    for i in range(3):
        for j in range(4):
            assert np.array_equal(together[i, j], fs.brightest_pixels(g[i, j], keep[j], rule=rule))


@pytest.mark.parametrize(("bad", "words"), BAD_IMAGES)
def test_bad_images(bad: Any, words: str) -> None:
    with refused("images", words):
        fs.brightest_pixels(bad, 1)


def test_one_pixel() -> None:
    with refused("images", "at least 2 pixels"):
        fs.brightest_pixels(np.ones((3, 1, 1)), 1)


@pytest.mark.parametrize(
    ("keep", "words"),
    [
        (0, "1 to 15"),
        (-3, "1 to 15"),
        (16, "1 to 15"),
        (2.5, "whole number"),
        (np.nan, "finite"),
        ("many", "real numbers"),
        (None, "real numbers"),
        ([1, 2], "broadcast"),
        ([1, 2, 99], "99"),
        (np.ones((3, 1), int), "broadcast"),
        ([], "empty"),
    ],
)
def test_bad_number(keep: Any, words: str) -> None:
    with refused("keep", words):
        fs.brightest_pixels(np.ones((3, 4, 4)), keep)


def test_most_that_each_rule_keeps() -> None:
    g = np.eye(4)
    for rule in ("threshold", "subtract_kth"):
        fs.brightest_pixels(g, 16, rule=rule)
        with refused("keep", "1 to 16"):
            fs.brightest_pixels(g, 17, rule=rule)


@pytest.mark.parametrize("rule", ["max", None, 1, ["threshold"]])
def test_unknown_rule(rule: Any) -> None:
    with refused("rule", "'subtract_next', 'threshold', 'subtract_kth'"):
        fs.brightest_pixels(np.eye(4), 3, rule=rule)
