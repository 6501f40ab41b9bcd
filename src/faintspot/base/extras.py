"""What only some have: optional packages, with the extra that installs them, and Linux."""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path

from faintspot.base.errors import InputError, MissingExtraError

EXTRAS = {
    "io": ("astropy", "h5py", "PIL", "tifffile", "zarr"),
    "web": ("matplotlib", "jinja2"),
    "study": ("xarray", "dask", "distributed", "bokeh"),
    "realtime": ("pyshmem", "aotpy"),
    "live": ("tornado",),
    "loop": ("hcipy",),
    "gpu": ("numba_cuda",),
    "oopao": ("OOPAO",),
    "specula": ("specula",),
    "soapy": ("soapy",),
    "pyrtc": ("pyrtc",),
}
"""Packages by the extra to name where one is missing; some extras bring those of others along."""
SHARED_MEMORY = Path("/dev/shm")
"""Where Linux keeps named shared memory."""


def present(package: str) -> bool:
    """Tell whether a package can be imported, without importing it."""
    try:
        return importlib.util.find_spec(package) is not None
    except (ImportError, ValueError):
        return False


def require(extra: str, *packages: str, purpose: str) -> None:
    """Make sure that packages are installed, before work begins.

    Parameters
    ----------
    extra : str
        What installs all of them.
    packages : str
        Names to import.
    purpose : str
        What needs them, the beginning of the message.

    Raises
    ------
    MissingExtraError
        When one or more are not.
    """
    missing = [package for package in packages if not present(package)]
    if missing:
        raise MissingExtraError(" and ".join(missing), extra, purpose)


def require_linux(purpose: str) -> None:
    """Make sure that this is Linux, with its scheduler and shared memory, which real time needs.

    Parameters
    ----------
    purpose : str
        What needs it, the beginning of the message.

    Raises
    ------
    InputError
        When it is not.
    """
    if not hasattr(os, "sched_setscheduler"):
        raise InputError(f"{purpose} needs Linux")
    if not SHARED_MEMORY.is_dir():
        raise InputError(f"{purpose} needs shared memory in {SHARED_MEMORY}, which Linux has")
