"""Tests that run kernels: on a GPU where there is one, else in Numba's simulator, else not at all.

The simulator must be asked for before Numba is imported, so that it has a process of its own: see
test_simulator.py.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

_WAITING_S = 1e-4  # the simulator's threads wait for each other all the time


def shared_array(memory: Any, shape: Any, dtype: Any, alignment: Any = None) -> Any:
    """As the simulator's own, but that two threads that ask at once get the same array."""
    from numba.np.numpy_support import as_dtype

    frame = sys._getframe(1)
    place = frame.f_code.co_filename, frame.f_lineno
    return memory._allocations.setdefault(place, np.empty(shape, as_dtype(dtype)))


@pytest.fixture(autouse=True)
def device(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    pytest.importorskip("numba_cuda", reason="needs the extra gpu")
    from numba import cuda

    from faintspot.slopes.kernels.cuda.availability import simulated

    if not cuda.is_available():
        pytest.skip("needs a GPU; tests/slopes/kernels/cuda/test_simulator.py runs this in Numba's simulator")
    interval = sys.getswitchinterval()
    if simulated():
        from numba.cuda.simulator.kernelapi import FakeCUDAShared

        sys.setswitchinterval(_WAITING_S)
        monkeypatch.setattr(FakeCUDAShared, "array", shared_array)
    yield
    sys.setswitchinterval(interval)
