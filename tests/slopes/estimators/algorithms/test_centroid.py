from typing import Any

import numpy as np
import pytest
from hypothesis import given
from tests import naive
from tests.refusals import refused
from tests.slopes.estimators.algorithms.image_cases import BAD_IMAGES, images

import faintspot as fs

every_dtype = pytest.mark.parametrize("dtype", [np.float32, np.float64])


@every_dtype
@given(images())
def test_equals_oracle(dtype: Any, stack: Any) -> None:
    stack = np.abs(stack).astype(dtype)  # where signs cancel the quotient of two rounded sums is anything
    stack[np.abs(stack) < 1e-30] = 0
    result = fs.centre_of_gravity(stack)
    assert result.dtype == dtype
    expected = [naive.centre_of_gravity(g) for g in stack]
    # Each of three sums of up to 4,096 terms rounds; the moments' terms are up to half a window.
    assert np.allclose(result, expected, rtol=0, atol=30 * np.finfo(dtype).eps * max(stack.shape[1:]))


@every_dtype
@pytest.mark.parametrize("value", [0.0, -1.0, -1e-44])
def test_without_flux(dtype: Any, value: float) -> None:
    assert np.array_equal(fs.centre_of_gravity(np.full((3, 4, 4), value, dtype)), np.zeros((3, 2)))


def test_sum_that_cancels_is_never_nan() -> None:
    g = np.array([[1.0, -1.0], [1.0, -1.0]])
    assert np.array_equal(fs.centre_of_gravity(g), [0.0, 0.0])


@every_dtype
def test_however_faint(dtype: Any) -> None:
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
def test_leading_shapes(leading: tuple[int, ...]) -> None:
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
def test_bad_images(bad: Any, words: str) -> None:
    with refused("images", words):
        fs.centre_of_gravity(bad)
