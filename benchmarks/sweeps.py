"""The denoiser's sweep on its own, many times in one call: as Numba compiles it, and in C++ (sweep.cpp)."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from faintspot.kernels import sweeps as kernel
from faintspot.kernels.gravity import gravity_scratch
from faintspot.kernels.host import lanes_for
from faintspot.kernels.simd import splat, store

SIDE = 16
MOMENTUM, INVERSE = 0.5, 0.3  # of an ordinary iteration; their values do not change the work
_sweep = kernel.sweep_fgp

Sweeps = Callable[[int], None]


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

    def cpp(self, library: ctypes.CDLL) -> Sweeps:
        """Return the function that sweeps `count` times in C++."""
        function = getattr(library, f"sweeps_{self.width}")
        function.restype = None
        pointers = [array.ctypes.data_as(ctypes.c_void_p) for array in (self.state, self.rows, self.norm)]
        side = ctypes.c_long(self.side)
        momentum, inverse = ctypes.c_float(MOMENTUM), ctypes.c_float(INVERSE)

        def sweep(count: int) -> None:
            function(
                pointers[0], pointers[1], side, side, ctypes.c_long(count), momentum, inverse, pointers[2]
            )

        return sweep


def cpp_library() -> ctypes.CDLL | None:
    """Compile sweep.cpp for this machine and load it; None where there is no g++."""
    compiler = shutil.which("g++")
    if compiler is None:
        return None
    source = Path(__file__).with_name("sweep.cpp")
    with tempfile.TemporaryDirectory() as folder:
        module, library = f"{folder}/sweep.o", f"{folder}/sweep.so"
        options = ["-std=c++17", "-O3", "-march=native", "-ffast-math", "-fPIC"]
        subprocess.run([compiler, *options, "-c", str(source), "-o", module], check=True)
        # Linked without -ffast-math, which would switch off denormal numbers in this whole process.
        subprocess.run([compiler, "-shared", module, "-o", library], check=True)
        return ctypes.CDLL(library)


def largest_difference(library: ctypes.CDLL, width: int, count: int = 20) -> float:
    """Return the largest difference of the dual fields after `count` sweeps, Numba against C++."""
    ours, theirs = Group(width), Group(width)
    ours.numba(count)
    theirs.cpp(library)(count)
    return float(np.abs(ours.state - theirs.state).max())
