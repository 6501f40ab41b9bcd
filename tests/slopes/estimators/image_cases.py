"""Images and messages that the tests of the estimators share."""

from collections.abc import Callable
from typing import Any

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

KINDS: dict[str, Callable[[np.random.Generator, tuple[int, int]], NDArray[Any]]] = {
    "normal": lambda rng, shape: rng.normal(size=shape),
    "negative": lambda rng, shape: -5.0 - rng.random(shape),
    "offset": lambda rng, shape: 100.0 + rng.normal(size=shape),
    "photons": lambda rng, shape: rng.poisson(0.3, shape).astype(float),
    "ties": lambda rng, shape: rng.integers(0, 3, shape).astype(float),
    "outliers": lambda rng, shape: rng.standard_cauchy(shape),
    "hot pixel": lambda rng, shape: _hot_pixel(rng, shape),
    "zeros": lambda rng, shape: np.zeros(shape),
    "constant": lambda rng, shape: np.full(shape, rng.normal()),
    "ramp": lambda rng, shape: np.add.outer(np.arange(shape[0]), np.arange(shape[1])).astype(float),
}
# Units in which an image may come: 1e30 is the largest float32 allowed at the door; 1e-40 is subnormal there.
MAGNITUDES = (1.0, 1.0, 1e-3, 1e5, 1e-12, 1e12, 1e-25, 1e25)


def _hot_pixel(rng: np.random.Generator, shape: tuple[int, int]) -> NDArray[Any]:
    image = rng.normal(size=shape)
    image[rng.integers(shape[0]), rng.integers(shape[1])] = 1e4
    return image


@st.composite
def images(draw: st.DrawFn, count: int | None = None) -> NDArray[np.float64]:
    """(n, ny, nx) images, mostly small, each of its own kind; float64."""
    largest = draw(st.sampled_from([12] * 9 + [64]))
    shape = (draw(st.integers(2, largest)), draw(st.integers(2, largest)))
    n = draw(st.integers(1, 5 if largest == 12 else 1)) if count is None else count
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    kinds = draw(st.lists(st.sampled_from(sorted(KINDS)), min_size=n, max_size=n))
    return np.array([KINDS[kind](rng, shape) for kind in kinds]) * draw(st.sampled_from(MAGNITUDES))


def spread(stack: NDArray[Any]) -> NDArray[np.float64]:
    """rms(g - mean(g)) of each image, in float64 without overflow."""
    values = np.asarray(stack, np.float64)
    deviation = values - values.mean(axis=(-2, -1), keepdims=True)
    scale = np.max(np.abs(deviation), axis=(-2, -1), keepdims=True)
    scaled = np.divide(deviation, scale, out=np.zeros_like(deviation), where=scale > 0)
    result: NDArray[np.float64] = scale[..., 0, 0] * np.sqrt(np.mean(scaled**2, axis=(-2, -1)))
    return result


def largest(stack: NDArray[Any]) -> NDArray[np.float64]:
    """Largest magnitude of each image."""
    magnitudes: NDArray[np.float64] = np.max(np.abs(np.asarray(stack, np.float64)), axis=(-2, -1))
    return magnitudes


BAD_IMAGES: list[tuple[Any, str]] = [
    ([[1.0, np.nan], [0.0, 1.0]], "1 NaN or infinite of 4"),
    ([[1.0, np.inf], [0.0, 1.0]], "finite"),
    (np.ones((2, 2), complex), "complex"),
    ([["a", "b"], ["c", "d"]], "real numbers"),
    ([[1.0, 2.0], [1.0]], "images"),
    (np.empty((0, 4, 4)), "empty"),
    (np.empty((4, 0)), "empty"),
    ([1.0, 2.0], "2 dimensions"),
    (3.0, "2 dimensions"),
    (None, "images"),
    (np.array([["2020-01-01"] * 2] * 2, "datetime64[D]"), "datetime64"),
    (np.full((2, 2), 2e30, np.float32), "1e+30"),
    (np.full((2, 2), 1e300), "1e+290"),
]
