"""The vector type: every operation equals NumPy's on each lane."""

from typing import Any

import numpy as np
import pytest
from numba import njit

from faintspot.slopes.kernels.host import lanes_for
from faintspot.slopes.kernels.simd import (
    absolute,
    any_lane,
    get,
    load,
    maximum,
    minimum,
    multiply_add,
    put,
    select,
    splat,
    square_root,
    store,
    store_all,
    width_of,
)


@njit(error_model="numpy")
def _apply_all(lanes: Any, a: Any, b: Any, results: Any) -> Any:
    """Every operation on one pair of vectors; row i of the results holds the i-th."""
    width = width_of(lanes)
    x, y = load(lanes, a, 0), load(lanes, b, 0)
    one, zero = splat(lanes, 1.0), splat(lanes, 0)
    store(results, 0 * width, x + y)
    store(results, 1 * width, x - y)
    store(results, 2 * width, x * y)
    store(results, 3 * width, x / y)
    store(results, 4 * width, multiply_add(x, y, one))
    store(results, 5 * width, square_root(absolute(x)))
    store(results, 6 * width, one / square_root(absolute(x)))
    store(results, 7 * width, absolute(x))
    store(results, 8 * width, maximum(x, y))
    store(results, 9 * width, minimum(x, y))
    selected = (
        select(x > y, x, zero),
        select(x < y, x, zero),
        select(x >= y, x, zero),
        select(x <= y, x, zero),
    )
    store_all(results, 10 * width, selected)
    put(results, 14 * width, get(a, 1))
    return any_lane(x > y), any_lane(x > x)


@pytest.mark.parametrize(("dtype", "width"), [("float32", 4), ("float32", 16), ("float64", 8)])
def test_operations_on_lanes_are_those_of_numpy(dtype: str, width: int) -> None:
    lanes = lanes_for(dtype, width)
    width = lanes.width
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=(2, width)).astype(dtype)
    b[::3] = a[::3]
    results = np.zeros(15 * width, dtype)
    anywhere, nowhere = _apply_all(lanes, a, b, results)
    zero = np.zeros_like(a)
    expected = [
        a + b,
        a - b,
        a * b,
        a / b,
        a * b + 1,
        np.sqrt(np.abs(a)),
        1 / np.sqrt(np.abs(a)),
        np.abs(a),
        np.maximum(a, b),
        np.minimum(a, b),
        np.where(a > b, a, zero),
        np.where(a < b, a, zero),
        np.where(a >= b, a, zero),
        np.where(a <= b, a, zero),
    ]
    rows = results.reshape(15, width)
    for i, row in enumerate(expected):
        exact = i not in (4, 6)  # fused, and two roundings
        assert np.allclose(rows[i], row, rtol=0 if exact else 8 * np.finfo(dtype).eps, atol=0), i
    assert rows[14, 0] == a[1]
    assert bool(anywhere) == bool(np.any(a > b))
    assert not nowhere


def test_any_lane_of_no_lane() -> None:
    lanes = lanes_for("float32", 4)
    ones, results = np.ones(4, np.float32), np.zeros(60, np.float32)
    assert not _apply_all(lanes, ones, ones, results)[0]
    assert _apply_all(lanes, ones, np.array([1, 1, 1, 0], np.float32), results)[0]
