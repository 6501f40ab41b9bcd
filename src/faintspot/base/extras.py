"""Names imported on first use, and optional requirements: Linux, and packages with their extra."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from pkgutil import iter_modules
from typing import Any

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
        return find_spec(package) is not None
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


def lazy_attributes(package: str, homes: Mapping[str, str]) -> Callable[[str], object]:
    """Return the `__getattr__` of a package.

    Parameters
    ----------
    package : str
        Name of the package.
    homes : mapping of str
        Module that defines each public name; a name may also be a module of the package.
    """

    def get(name: str) -> Any:
        """Import a public name on first use."""
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        home = import_module(homes[name])
        value = home if home.__name__ == f"{package}.{name}" else getattr(home, name)
        setattr(sys.modules[package], name, value)
        return value

    return get


def lazy_packages(package: str, names: str) -> Callable[[str], object]:
    """Return the `__getattr__` of a package whose sub-packages (names separated by spaces) load lazily."""
    return lazy_attributes(package, {name: f"{package}.{name}" for name in names.split()})


def import_modules(package: str) -> list[str]:
    """Import the modules of a package, in alphabetical order, and return their full names."""
    found = iter_modules(import_module(package).__path__, f"{package}.")
    return [import_module(module.name).__name__ for module in found if not module.ispkg]
