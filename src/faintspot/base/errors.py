"""Exceptions that faintspot raises for invalid input, always with one line of text."""


class InputError(ValueError):
    """Argument, file or configuration that cannot be used.

    The message is one line that names the value, what was expected and where it was found. The command line
    prints it and exits with code 2.

    Examples
    --------
    >>> import faintspot as fs
    >>> fs.Settings(noise_std=-1.0)
    Traceback (most recent call last):
        ...
    faintspot.base.errors.InputError: noise_std = -1: expected a number of at least 0
    """

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.splitlines()))  # values in the message may have several lines


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
