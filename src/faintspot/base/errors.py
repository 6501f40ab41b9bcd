"""Errors of one line, names imported on first use, and optional requirements: Linux, packages of an extra."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from pkgutil import iter_modules
from typing import Any

_FOR_TYPE_CHECKERS = re.compile(r"^    from (\S+) import \(?\s*(\w+) as \2\b", re.MULTILINE)


class InputError(ValueError):
    """Argument, file or configuration that cannot be used.

    The message is one line that names the value, what was expected and where it was found. The command line
    prints it and exits with code 2.

    Parameters
    ----------
    expected : str
        What was expected, or the whole message.
    name : str
        Name of the value; empty if the message has none.
    value : object
        The value, if the message shows it.
    where : str
        File or part of a file in which it was found.

    Examples
    --------
    >>> import faintspot as fs
    >>> fs.Settings(noise_std=-1.0)
    Traceback (most recent call last):
        ...
    faintspot.base.errors.InputError: noise_std = -1: expected a number of at least 0
    """

    def __init__(self, expected: str, *, name: str = "", value: object = ..., where: str = "") -> None:
        self.expected, self.name, self.value, self.where = expected, name, value, where
        shown = "" if value is ... else f" = {value:g}" if isinstance(value, float) else f" = {value!r}"
        message = ": ".join(part for part in (where, name and f"{name}{shown}", expected) if part)
        super().__init__(" ".join(message.splitlines()))  # values in the message may have several lines

    def within(self, where: object, prefix: str = "") -> InputError:
        """Return the error of a value that stands in `where`, under a name that begins with `prefix`."""
        name = f"{prefix}{self.name}" if self.name else ""
        outer = ": ".join(part for part in (f"{where}", self.where) if part)
        return InputError(self.expected, name=name, value=self.value, where=outer)


@contextmanager
def errors_within(where: object, prefix: str = "") -> Iterator[None]:
    """Add the file or part to the errors raised within; see `InputError.within`."""
    try:
        yield
    except InputError as error:
        raise error.within(where, prefix) from None


class MissingExtraError(ImportError):
    """Missing optional dependency; the message names the extra that installs it.

    Examples
    --------
    >>> import faintspot as fs
    >>> print(fs.MissingExtraError("zarr", "io", "reading Zarr stores"))
    reading Zarr stores needs zarr: install it with pip install 'faintspot[io]'
    """

    def __init__(self, package: str, extra: str, purpose: str) -> None:
        super().__init__(f"{purpose} needs {package}: install it with pip install 'faintspot[{extra}]'")


class CacheWarning(RuntimeWarning):
    """Compiled kernels cannot be cached on disk; the message states what to set."""


class DoubtWarning(UserWarning):
    """A layout is doubtful, and nobody has settled it."""


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


def lazy_names(package: str) -> tuple[Callable[[str], object], Callable[[], list[str]], list[str]]:
    """Return `__getattr__`, `__dir__` and `__all__` of a package whose public names load on first use.

    The names are those that its source imports for type checkers, under `if TYPE_CHECKING`, each in a line
    of its own and as itself: modules of the package, and names from any module.
    """
    module: Any = sys.modules[package]
    source = module.__spec__.loader.get_data(module.__file__)  # also from a zip file
    homes = {name: home for home, name in _FOR_TYPE_CHECKERS.findall(source.decode("utf-8"))}
    names = sorted(homes)

    def get(name: str) -> Any:
        """Import a public name on first use."""
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        is_module = homes[name] == package
        value = import_module(f"{package}.{name}") if is_module else getattr(import_module(homes[name]), name)
        setattr(module, name, value)
        return value

    return get, lambda: names, names


def import_modules(package: str) -> list[str]:
    """Import the modules of a package, in alphabetical order, and return their full names."""
    found = iter_modules(import_module(package).__path__, f"{package}.")
    return [import_module(module.name).__name__ for module in found if not module.ispkg]


def drawn(function: str, *arguments: Any, **options: Any) -> Any:
    """Call a function "module:name" that draws an object; it lies above the object and is imported now."""
    module, _, name = function.partition(":")
    return getattr(import_module(f"faintspot.{module}"), name)(*arguments, **options)


_FILE_PACKAGES = {
    "astropy.io.fits": ("astropy", "Reading or writing a FITS file"),
    "filelock": ("filelock", "Writing slopes that can be resumed"),
    "h5py": ("h5py", "Reading an HDF5 or MATLAB 7.3 file"),
    "PIL.Image": ("pillow", "Reading a PNG, BMP, JPEG or compressed TIFF file"),
    "tifffile": ("tifffile", "Reading a TIFF file"),
    "zarr": ("zarr", "Reading or writing a Zarr store"),
}
"""Package and purpose of each module of the extra `io`."""


def load_package(module: str) -> Any:
    """Import a module of the extra `io`.

    Raises
    ------
    MissingExtraError
        If its package is not installed.
    """
    try:
        return import_module(module)
    except ImportError:
        package, purpose = _FILE_PACKAGES[module]
        raise MissingExtraError(package, "io", purpose) from None
