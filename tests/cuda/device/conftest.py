"""Tests that run kernels: on a GPU where there is one, else in Numba's simulator, else not at all.

The simulator must be asked for before Numba is imported, so that it has a process of its own: see
test_simulator.py.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator

import pytest

_WAITING_S = 1e-4  # the simulator's threads wait for each other all the time


@pytest.fixture(autouse=True)
def device() -> Iterator[None]:
    pytest.importorskip("numba_cuda", reason="needs the extra gpu")
    from numba import cuda

    from faintspot.cuda.availability import simulated

    if not cuda.is_available():
        pytest.skip("needs a GPU; tests/cuda/test_simulator.py runs this in Numba's simulator")
    interval = sys.getswitchinterval()
    if simulated():
        sys.setswitchinterval(_WAITING_S)
    yield
    sys.setswitchinterval(interval)
