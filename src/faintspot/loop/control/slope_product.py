"""Product of a matrix with the slopes of a frame, most of which is computed while the rows arrive."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from faintspot.slopes.kernels.compilation.compiling import Direct
from faintspot.slopes.kernels.driver.products import ProductMemory, ProductPart, add_products, finish_product

Floats = NDArray[np.float64]

_LEAST_BYTES = 500_000
"""Size of a matrix below which the product takes no longer than what it takes to begin it."""


class SlopeProduct:
    """Product of a matrix with the slopes of each frame, or with other vectors, in float32.

    A product that has been begun is that of the slopes as they were measured. When the whole product is asked
    for, only slopes that differ from these are left to do: those that have not been taken yet, and those that
    have changed since. Without a beginning these are all.

    Parameters
    ----------
    matrix : (c, 2 n) array
    """

    def __init__(self, matrix: NDArray[np.floating]) -> None:
        self.columns = np.ascontiguousarray(matrix.T, np.float32)
        """(2 n, c): the matrix, transposed."""
        m, c = self.columns.shape
        slopes, subtracted, result = (np.zeros(size, np.float32) for size in (m, m, c))
        self.memory = ProductMemory(slopes, subtracted, np.zeros((1, c), np.float32), result)
        self._expected = np.zeros(m)

    def __call__(self, vector: Floats) -> Floats:
        """Return the product, (c,)."""
        _FINISH(self.columns, vector, self.memory)
        return np.asarray(self.memory.result, np.float64)

    def several(self, *vectors: Floats) -> Floats:
        """Return the products with a few vectors, (vectors, c); the matrix is read once."""
        out = np.zeros((len(vectors), self.columns.shape[1]), np.float32)
        _ADD_PRODUCTS(self.columns, np.array(vectors, np.float32), out)
        return out.astype(np.float64)

    def parts(self, threads: int, scale: float, expected: Floats | None = None) -> Sequence[ProductPart]:
        """Return the parts of the next frame's product for each of the threads that measure its slopes.

        There are none of a small matrix, which is read faster than so many parts of it.

        Parameters
        ----------
        threads : int
        scale : float
            Factor on measured slopes.
        expected : (2 n,) array, optional
            Subtracted from scaled slopes. Default: 0.
        """
        if self.columns.nbytes < _LEAST_BYTES:
            return ()
        if len(self.memory.outs) != threads:
            outs = np.zeros((threads, self.columns.shape[1]), np.float32)
            self.memory = self.memory._replace(outs=outs)
        self._expected[:] = 0.0 if expected is None else expected
        slopes, subtracted, outs, _ = self.memory
        return [ProductPart(self.columns, scale, self._expected, slopes, subtracted, out) for out in outs]


_ADD_PRODUCTS, _FINISH = Direct(add_products), Direct(finish_product)
