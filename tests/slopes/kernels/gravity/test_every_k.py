"""Positions of every k at once are those of the public functions, one k after the other."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import faintspot as fs
from faintspot.slopes.kernels.gravity import every_k

FLOOR = 1e-4
RULES = {"subtract_next": every_k.SUBTRACT_NEXT, "threshold": every_k.THRESHOLD}


def positions_of_all(
    images: NDArray[np.float32], rule: str, reach: float = math.inf
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    n, side, _ = images.shape
    positions, valid = np.full((n, side**2 - 1, 2), np.nan), np.zeros((n, side**2 - 1), bool)
    flat = images.reshape(n, -1)
    every_k.positions_of_every_k(flat, side, RULES[rule], FLOOR, reach, 0, n, positions, valid)
    return positions, valid


def one_by_one(images: NDArray[np.floating], rule: str) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """The definition, step by step."""
    positions, valid = [], []
    for k in range(1, images.shape[1] ** 2):
        left = fs.brightest_pixels(images, keep=k, rule=rule)
        illuminated = left.sum(axis=(1, 2), dtype=np.float64) > FLOOR * np.abs(images).max(axis=(1, 2))
        positions.append(np.where(illuminated[:, None], fs.centre_of_gravity(left), 0.0))
        valid.append(illuminated)
    return np.stack(positions, axis=1), np.stack(valid, axis=1)


@pytest.mark.parametrize("rule", RULES)
@given(
    seed=st.integers(0, 2**32 - 1),
    side=st.sampled_from([4, 5, 8, 16]),
    levels=st.sampled_from([0, 1, 3, 100]),
    offset=st.sampled_from([0.0, -3.0, 5.0]),
)
def test_every_k_is_the_definition(rule: str, seed: int, side: int, levels: int, offset: float) -> None:
    rng = np.random.default_rng(seed)
    images = rng.normal(size=(3, side, side)) * 10.0 ** rng.integers(-3, 4)
    if levels:  # ties
        images = np.rint(images / np.abs(images).max() * levels)
    single = (images + offset).astype(np.float32)
    positions, valid = positions_of_all(single, rule)
    expected, illuminated = one_by_one(single.astype(np.float64), rule)
    # Round-off of double precision, magnified where low flux is left above the floor.
    clear = valid == illuminated
    assert np.mean(~clear) < 0.01  # only where the sum is at the floor itself
    np.testing.assert_allclose(positions[clear], expected[clear], rtol=0, atol=1e-8)


@pytest.mark.parametrize("rule", RULES)
def test_equal_to_float32_rounding_on_spots(rule: str) -> None:
    images, _ = fs.slopes.simulate.subapertures(40, flux_e=300.0, rng=np.random.default_rng(5))
    positions, valid = positions_of_all(images, rule)
    expected, _ = one_by_one(images, rule)
    assert valid.all()
    # Sums of up to 255 terms in single precision: 255 * 6e-8 of a window's half, 8 px, is 1e-4.
    np.testing.assert_allclose(positions, expected, rtol=0, atol=1e-4)


@pytest.mark.parametrize("rule", RULES)
def test_positions_stay_within_reach(rule: str) -> None:
    images, _ = fs.slopes.simulate.subapertures(50, shape=(8, 8), flux_e=10.0, rng=np.random.default_rng(7))
    free, valid = positions_of_all(images, rule)
    held, also_valid = positions_of_all(images, rule, 0.4)
    assert np.abs(free).max() > 1.0
    np.testing.assert_array_equal(held, np.clip(free, -0.4, 0.4))
    np.testing.assert_array_equal(valid, also_valid)


def test_flat_and_extreme_images() -> None:
    tiny = np.zeros((1, 4, 4), np.float32)
    tiny[0, 1, 2] = 1e-30
    for image in (np.zeros((1, 4, 4), np.float32), np.full((1, 4, 4), 7.1, np.float32)):
        positions, valid = positions_of_all(image, "subtract_next")
        assert not valid.any()
        assert not positions.any()
    positions, valid = positions_of_all(tiny, "subtract_next")
    assert valid.all()
    np.testing.assert_allclose(positions[0], np.broadcast_to([0.5, -0.5], (15, 2)))
