"""Optional requirements: packages, with the extra that installs them, and Linux."""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path

from faintspot.base.errors import InputError, MissingExtraError

EXTRAS = {
    "io": ("astropy", "filelock", "h5py", "PIL", "tifffile", "zarr"),
    "report": ("matplotlib", "jinja2"),
    "loop": ("hcipy", "joblib", "xarray"),
    "cluster": ("distributed",),
    "realtime": ("pyshmem", "aotpy", "tornado"),
    "oopao": ("OOPAO",),
    "specula": ("specula",),
    "soapy": ("soapy",),
    "pyrtc": ("pyrtc",),
}
"""Packages by the extra that messages name when one is missing; some extras include others."""
SHARED_MEMORY = Path("/dev/shm")
"""Folder of named shared memory on Linux."""


def present(package: str) -> bool:
    """Return whether a package can be imported, without importing it."""
    try:
        return importlib.util.find_spec(package) is not None
    except (ImportError, ValueError):
        return False


def require(extra: str, *packages: str, purpose: str) -> None:
    """Check that packages are installed, before work begins.

    Parameters
    ----------
    extra : str
        Extra that installs all of them.
    packages : str
        Names to import.
    purpose : str
        Feature that needs them, which begins the message.

    Raises
    ------
    MissingExtraError
        If one or more are not installed.
    """
    missing = [package for package in packages if not present(package)]
    if missing:
        raise MissingExtraError(" and ".join(missing), extra, purpose)


def require_linux(purpose: str) -> None:
    """Check for Linux, whose scheduler and shared memory real time requires.

    Parameters
    ----------
    purpose : str
        Feature that needs Linux, which begins the message.

    Raises
    ------
    InputError
        If the system is not Linux.
    """
    if not hasattr(os, "sched_setscheduler"):
        raise InputError(f"{purpose} needs Linux")
    if not SHARED_MEMORY.is_dir():
        raise InputError(f"{purpose} needs shared memory in {SHARED_MEMORY}, which Linux has")
