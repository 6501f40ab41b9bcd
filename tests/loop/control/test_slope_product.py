"""A product that is begun while slopes arrive is the whole product, whatever the slopes turn out to be."""

from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

from faintspot.base.flags import SubapertureFlag
from faintspot.loop.control import integrator
from faintspot.loop.control.integrator import SlopeProduct
from faintspot.slopes.kernels.products import add_slopes

N, COMMANDS, SCALE = 45, 31, 1.25
MATRIX = np.random.default_rng(1).standard_normal((COMMANDS, 2 * N))
TOLERANCE = 1e-5
"""Of float32, with sums of 90 products of numbers of order 1."""


@pytest.fixture(autouse=True)
def _small_matrices(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(integrator, "_LEAST_BYTES", 0)


class Measured:
    """Slopes of a frame."""

    def __init__(self) -> None:
        rng = np.random.default_rng(2)
        self.x, self.y = rng.standard_normal((2, N)).astype(np.float32)
        self.flags = np.zeros(N, np.uint8)
        self.expected = rng.standard_normal(2 * N)

    def ranges(self, threads: int) -> Iterator[tuple[int, int, int]]:
        """Return ranges of sub-apertures with the threads that measure them."""
        for count, start in enumerate(range(0, N, 7)):
            yield count % threads, start, min(start + 7, N)

    @property
    def vector(self) -> NDArray[np.float64]:
        """Vector of which the product is wanted."""
        slopes = SCALE * np.concatenate([self.x, self.y]).astype(np.float64) - self.expected
        valid = np.isfinite(self.x) & np.isfinite(self.y) & (self.flags != SubapertureFlag.NO_FLUX)
        return np.where(np.tile(valid, 2), slopes, 0.0)


@pytest.mark.parametrize("threads", [1, 2])
def test_what_is_left_is_added(threads: int) -> None:
    product = SlopeProduct(MATRIX)
    for begun in (0, 3, 7):
        measured = Measured()
        measured.flags[[3, 20]] = SubapertureFlag.NO_FLUX, SubapertureFlag.SATURATED
        measured.x[8], measured.y[9] = np.nan, np.inf
        parts = product.parts(threads, SCALE, measured.expected)
        for thread, start, stop in list(measured.ranges(threads))[:begun]:
            add_slopes(parts[thread], measured.x, measured.y, measured.flags, start, stop)
        vector = measured.vector
        np.testing.assert_allclose(product(vector), MATRIX @ vector, atol=TOLERANCE)
        assert not product.memory.taken.any()  # nothing is left for the next frame
        assert not product.memory.outs.any()
        np.testing.assert_array_equal(product(vector), product.several(vector)[0])  # bit for bit


def test_slopes_that_change_afterwards_are_corrected() -> None:
    product, measured = SlopeProduct(MATRIX), Measured()
    parts = product.parts(2, SCALE, measured.expected)
    for _ in range(2):  # to measure a group again does no harm
        for thread, start, stop in measured.ranges(2):
            add_slopes(parts[thread], measured.x, measured.y, measured.flags, start, stop)
    measured.flags[[0, 44]] = SubapertureFlag.NO_FLUX
    measured.x[5:9] += 1.0
    vector = measured.vector
    np.testing.assert_allclose(product(vector), MATRIX @ vector, atol=TOLERANCE)


def test_all_slopes_were_as_measured_then_nothing_is_left() -> None:
    """The matrix is not read again: that it has changed is not seen."""
    product, measured = SlopeProduct(MATRIX), Measured()
    (part,) = product.parts(1, SCALE, measured.expected)
    add_slopes(part, measured.x, measured.y, measured.flags, 0, N)
    vector = measured.vector
    product.columns[:] = 1e9
    np.testing.assert_allclose(product(vector), MATRIX @ vector, atol=TOLERANCE)


def test_what_is_not_finite_stays_in_its_frame() -> None:
    """Nor are there rounding errors of huge numbers. 3e38 times the scale exceeds float32."""
    product, whole = SlopeProduct(MATRIX), Measured()
    vector = whole.vector
    with np.errstate(all="ignore"):
        for bad in (np.nan, np.inf, 1e300):
            assert not np.isfinite(product(np.full(2 * N, bad))).any()
            np.testing.assert_array_equal(product(vector), SlopeProduct(MATRIX)(vector))
        for bad in (np.nan, np.inf, 3e38, 1e30):
            measured = Measured()
            (part,) = product.parts(1, SCALE, measured.expected)
            measured.x[[3, 30]] = measured.y[12] = bad
            add_slopes(part, measured.x, measured.y, measured.flags, 0, N)
            assert product.memory.taken.any()
            np.testing.assert_allclose(product(vector), MATRIX @ vector, atol=TOLERANCE)
    (part,) = product.parts(1, SCALE, np.full(2 * N, np.nan))
    add_slopes(part, whole.x, whole.y, whole.flags, 0, N)
    np.testing.assert_allclose(product(vector), MATRIX @ vector, atol=TOLERANCE)


def test_small_matrices_are_not_begun(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    assert not SlopeProduct(MATRIX).parts(1, SCALE)


def test_several_vectors_are_multiplied_at_once() -> None:
    vectors = np.random.default_rng(3).standard_normal((3, 2 * N))
    np.testing.assert_allclose(SlopeProduct(MATRIX).several(*vectors), vectors @ MATRIX.T, atol=TOLERANCE)
