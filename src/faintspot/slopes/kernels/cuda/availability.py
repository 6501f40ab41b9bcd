"""Whether there is a GPU, or Numba's simulator of one, to measure with."""

from __future__ import annotations

import importlib.util

from faintspot.base.errors import InputError, MissingExtraError

_PURPOSE = 'device="cuda"'


def simulated() -> bool:
    """Whether Numba simulates CUDA in this process (NUMBA_ENABLE_CUDASIM=1 before it was imported)."""
    from numba import config

    return bool(config.ENABLE_CUDASIM)


def check_cuda() -> None:
    """Make sure that kernels can run.

    Raises
    ------
    MissingExtraError
        Without the extra `gpu`.
    InputError
        Without a GPU and its driver.
    """
    if importlib.util.find_spec("numba_cuda") is None:
        raise MissingExtraError("numba-cuda", "gpu", _PURPOSE)
    from numba import cuda

    if not (simulated() or cuda.is_available()):
        raise InputError(
            f'{_PURPOSE}: no NVIDIA GPU with a working driver was found; use device="cpu", or set '
            "NUMBA_ENABLE_CUDASIM=1 to try it, slowly, without one"
        )
