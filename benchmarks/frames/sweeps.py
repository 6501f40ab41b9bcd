"""The denoiser's sweep on its own, many times in one call."""

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from faintspot.slopes.kernels.host import lanes_for
from faintspot.slopes.kernels.positions.gravity import gravity_scratch
from faintspot.slopes.kernels.simd import splat, store
from faintspot.slopes.kernels.total_variation import sweeps as kernel

SIDE = 16
MOMENTUM, INVERSE = 0.5, 0.3  # of an ordinary iteration; their values do not change the work
_sweep = kernel.sweep_fgp


# Not cached on disk: Numba shows the assembly of what it has just compiled only.
@njit(nogil=True, error_model="numpy")  # type: ignore[untyped-decorator, unused-ignore]
def numba_sweeps(
    lanes: Any, state: Any, rows: Any, ny: Any, nx: Any, count: Any, momentum: Any, inverse: Any, norm: Any
) -> None:
    """Sweep `count` times over one group of W images, and store the last norms."""
    current = 0
    last = splat(lanes, 0.0)
    for _ in range(count):
        last = _sweep(lanes, state, rows, ny, nx, current, splat(lanes, momentum), splat(lanes, inverse))
        current = 2 - current
    store(norm, 0, last)


class Group:
    """One group of W noise images in the kernel's layout, with everything that a sweep needs."""

    def __init__(self, width: int, side: int = SIDE) -> None:
        self.width, self.side = width, side
        self.lanes = lanes_for(np.float32, width)
        scratch = gravity_scratch(self.lanes, side, side)
        self.state, self.rows = scratch.state, scratch.rows
        pixels = self.state.reshape(side * side, kernel.STATE_VECTORS, width)
        generator = np.random.default_rng(1)
        pixels[:, kernel.IMAGE] = generator.standard_normal((side * side, width), np.float32)
        self.norm: NDArray[np.float32] = np.zeros(width, np.float32)

    def numba(self, count: int) -> None:
        """Sweep `count` times with the project's kernel."""
        numba_sweeps(
            self.lanes, self.state, self.rows, self.side, self.side, count, MOMENTUM, INVERSE, self.norm
        )
