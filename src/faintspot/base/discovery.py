"""Modules of a package, found by themselves: what is added as one more file needs no list."""

from __future__ import annotations

from importlib import import_module
from pkgutil import iter_modules


def import_modules(package: str) -> list[str]:
    """Import the modules of a package, in alphabetical order, and return their full names."""
    found = iter_modules(import_module(package).__path__, f"{package}.")
    return [import_module(module.name).__name__ for module in found if not module.ispkg]
