from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests import naive
from tests.refusals import assert_each_refused, refused
from tests.slopes.estimators.image_cases import BAD_IMAGES, images

import faintspot as fs
from faintspot.slopes.estimators.centroid import like_most, seen_spots
from faintspot.slopes.estimators.noise import pixel_noise
from faintspot.slopes.simulate import Detector, subapertures

every_dtype = pytest.mark.parametrize("dtype", [np.float32, np.float64])


@every_dtype
@given(images())
def test_centre_of_gravity_equals_the_oracle(dtype: Any, stack: Any) -> None:
    stack = np.abs(stack).astype(dtype)  # where signs cancel the quotient of two rounded sums is anything
    stack[np.abs(stack) < 1e-30] = 0
    result = fs.centre_of_gravity(stack)
    assert result.dtype == dtype
    expected = [naive.centre_of_gravity(g) for g in stack]
    # Each of three sums of up to 4,096 terms rounds; the moments' terms are up to half a window.
    assert np.allclose(result, expected, rtol=0, atol=30 * np.finfo(dtype).eps * max(stack.shape[1:]))


@every_dtype
@pytest.mark.parametrize("value", [0.0, -1.0, -1e-44])
def test_images_without_flux_have_their_centre(dtype: Any, value: float) -> None:
    assert np.array_equal(fs.centre_of_gravity(np.full((3, 4, 4), value, dtype)), np.zeros((3, 2)))


def test_sum_that_cancels_is_never_nan() -> None:
    g = np.array([[1.0, -1.0], [1.0, -1.0]])
    assert np.array_equal(fs.centre_of_gravity(g), [0.0, 0.0])


@every_dtype
def test_faintest_images_have_the_same_centre(dtype: Any) -> None:
    """Values of 1 to 100 smallest steps of the type, and the same image as it usually is."""
    generator = np.random.default_rng(4)
    stack = generator.integers(0, 100, (5, 6, 7)).astype(dtype)
    expected = fs.centre_of_gravity(stack)
    faintest = np.finfo(dtype).smallest_subnormal
    for scale in (faintest, 2**10 * faintest, np.finfo(dtype).tiny, 2**15 * np.finfo(dtype).tiny):
        mixed = np.concatenate([stack, stack * scale, np.zeros_like(stack)])
        result = fs.centre_of_gravity(mixed)
        assert np.array_equal(result[:5], expected)
        assert np.array_equal(result[5:10], expected)
        assert not result[10:].any()


@every_dtype
def test_sum_that_cancels_but_for_almost_nothing(dtype: Any) -> None:
    g = np.array([[1.0, -1.0, np.finfo(dtype).smallest_subnormal], [0.0, 0.0, 0.0]], dtype)
    for order in ([0, 1, 2], [2, 1, 0], [1, 0, 2]):
        assert np.isfinite(fs.centre_of_gravity(g[:, order])).all()


@pytest.mark.parametrize("leading", [(), (3,), (2, 3)])
def test_leading_dimensions_are_kept(leading: tuple[int, ...]) -> None:
    g = np.random.default_rng(1).random((*leading, 6, 4))
    copy = g.copy()
    g.flags.writeable = False
    result = fs.centre_of_gravity(g)
    assert result.shape == (*leading, 2)
    assert np.array_equal(g, copy)
    for index in np.ndindex(leading):
        assert np.array_equal(result[index], fs.centre_of_gravity(g[index]))


def test_lists_and_integers() -> None:
    assert np.array_equal(fs.centre_of_gravity([[0, 0], [0, 3]]), [0.5, 0.5])


@pytest.mark.parametrize(("bad", "words"), BAD_IMAGES)
def test_bad_images_are_refused(bad: Any, words: str) -> None:
    kept, denoised = partial(fs.brightest_pixels, keep=1), partial(fs.tv_denoise, noise_std=0.5)
    for function in (fs.centre_of_gravity, kept, denoised, pixel_noise, seen_spots):
        with refused("images", words):
            function(bad)


RULES = ("subtract_next", "threshold", "subtract_kth")
every_rule = pytest.mark.parametrize("rule", RULES)


@every_dtype
@every_rule
@given(images(), st.floats(0.0, 1.0))
def test_brightest_pixels_equal_sorting(rule: str, dtype: Any, stack: Any, fraction: float) -> None:
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
def test_numbers_of_pixels_out_of_range_are_refused(keep: Any, words: str) -> None:
    with refused("keep", words):
        fs.brightest_pixels(np.ones((3, 4, 4)), keep)


def test_most_that_each_rule_keeps() -> None:
    for rule in ("threshold", "subtract_kth"):
        fs.brightest_pixels(np.eye(4), 16, rule=rule)
        assert_each_refused(partial(fs.brightest_pixels, np.eye(4), rule=rule), keep=[17])
    unknown = ["max", None, 1, ["threshold"]]
    assert_each_refused(partial(fs.brightest_pixels, np.eye(4), 3), rule=unknown)
    with refused("images", "at least 2 pixels"):
        fs.brightest_pixels(np.ones((3, 1, 1)), 1)


@pytest.mark.parametrize(
    ("flux_e", "read_noise_e", "n"), [(1e5, 0.1, 50), (30.0, 0.1, 500), (100.0, 3.0, 2000)]
)
def test_width_and_flux_wherever_the_spots_are(flux_e: float, read_noise_e: float, n: int) -> None:
    """FWHM 3 px, elongated by 1.5, pixel included: 3.07 and 4.55; to 8 % where single spots are lost."""
    images, _ = subapertures(
        n,
        shape=(20, 20),
        flux_e=flux_e,
        profile="gaussian",
        size=1.5,
        elongation=1.5,
        position_range_px=3.0,
        detector=Detector(read_noise_e),
        rng=np.random.default_rng(1),
    )
    for scale in (1e-4, 1.0, 1e4):
        found = seen_spots(scale * images + 7.0 * scale)
        assert found.fwhm_x_px == pytest.approx(4.55, rel=0.08)
        assert found.fwhm_y_px == pytest.approx(3.07, rel=0.08)
        assert found.flux == pytest.approx(scale * flux_e, rel=0.1)


def test_images_without_spots_are_refused() -> None:
    assert_each_refused(seen_spots, images=[np.ones((5, 8, 8)), np.ones((5, 8, 3))])


@pytest.mark.parametrize("flux_e", [30.0, 500.0, 1e5])
def test_structures_are_unlike_most_spots(flux_e: float) -> None:
    """A bright gradient, a wide patch and a flare are left out, and almost no spot."""
    images, _ = subapertures(
        60,
        shape=(20, 20),
        flux_e=flux_e,
        profile="gaussian",
        size=1.5,
        position_range_px=3.0,
        detector=Detector(1.0),
        rng=np.random.default_rng(1),
    )
    row, column = np.mgrid[:20, :20]
    images[3] += 0.2 * flux_e * column
    images[17] += 0.2 * flux_e * np.exp(-0.5 * ((column - 9.0) ** 2 + (row - 11.0) ** 2) / 6.0**2)
    images[40, 5:9, 5:9] += flux_e
    kept = like_most(images[None])
    assert not kept[[3, 17, 40]].any()
    assert np.count_nonzero(kept) >= 55


@pytest.mark.parametrize("fwhm_px", [0.6, 1.0, 1.6])
def test_spots_sharper_than_nyquist(fwhm_px: float) -> None:
    """Width with the blur of the pixels, sqrt(12) of whose standard deviation are one of them."""
    images, _ = subapertures(
        300,
        shape=(12, 12),
        flux_e=5000.0,
        profile="gaussian",
        size=0.5 * fwhm_px,
        position_range_px=1.0,
        detector=Detector(3.0),
        rng=np.random.default_rng(1),
    )
    found = seen_spots(images)
    blurred = np.hypot(fwhm_px, 2.3548 / np.sqrt(12))
    assert found[:2] == pytest.approx([blurred, blurred], rel=0.04)
    assert found.flux == pytest.approx(5000, rel=0.05)
