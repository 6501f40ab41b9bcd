"""Exceptions that faintspot raises for invalid input, always with one line of text."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


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
    """A layout is used about which `faintspot layout` had doubts that nobody has settled."""
