"""Public names imported on first use, so that importing a package is fast."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from pkgutil import iter_modules
from typing import Any


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
        home = importlib.import_module(homes[name])
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
