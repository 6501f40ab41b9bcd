"""The errors that faintspot raises for what a user gave it, always in one line."""


class InputError(ValueError):
    """A value from outside (argument, file, configuration) that cannot be used.

    The message is one line: it names the value, what was expected and where it was found.
    The command line prints it and exits with code 2.

    Examples
    --------
    >>> import faintspot as fs
    >>> fs.Settings(noise_std=-1.0)
    Traceback (most recent call last):
        ...
    faintspot.base.errors.InputError: noise_std = -1: expected a number of at least 0
    """

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.splitlines()))  # values that it shows may have several


class MissingExtraError(ImportError):
    """An optional dependency is absent; the message names the extra that installs it.

    Examples
    --------
    >>> import faintspot as fs
    >>> print(fs.MissingExtraError("zarr", "io", "reading Zarr stores"))
    reading Zarr stores needs zarr: install it with pip install 'faintspot[io]'
    """

    def __init__(self, package: str, extra: str, purpose: str) -> None:
        super().__init__(f"{purpose} needs {package}: install it with pip install 'faintspot[{extra}]'")


class CacheWarning(RuntimeWarning):
    """Compiled kernels cannot be kept on disk; the message says what to set."""
