"""TOML files: read with errors in one line, unknown names refused with the one that was meant."""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from faintspot.base.errors import InputError
from faintspot.base.files import read_bytes

_MOST_BYTES = 1 << 22  # a layout of 10,000 sub-apertures takes a tenth of it


def read_text(path: str | Path, *, if_missing: str = "") -> str:
    """Read the text of a TOML file.

    Parameters
    ----------
    path : path
    if_missing : str
        What to say beside "no such file", as who makes one.

    Raises
    ------
    InputError
        When the file cannot be read, is too large or is not UTF-8.
    """
    try:
        return read_bytes(path, "a TOML file", _MOST_BYTES).decode("utf-8")
    except FileNotFoundError:
        raise InputError(f"{path}: no such file{if_missing and f'; {if_missing}'}") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a TOML file: it is not UTF-8 text") from None


def parse_file(path: str | Path, *, if_missing: str = "") -> dict[str, Any]:
    """Read a TOML file; parameters and errors as `read_text`, and as `parse_text`."""
    return parse_text(read_text(path, if_missing=if_missing), str(path))


def parse_text(text: str, where: str) -> dict[str, Any]:
    """Read TOML text; `where` it was found is named in messages.

    Raises
    ------
    InputError
        When it is not TOML.
    """
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise InputError(f"{where}: not a TOML file: nested too deeply") from None
    except ValueError as error:  # also of numbers that Python does not read
        raise InputError(f"{where}: not a TOML file: {str(error).splitlines()[0]}") from None


def check_keys(
    prefix: str,
    table: Mapping[str, Any],
    known: Iterable[str],
    *,
    required: Iterable[str] = (),
    what: str = "key",
) -> None:
    """Refuse a table with a key that nobody knows, or without one that is needed.

    Parameters
    ----------
    prefix : str
        What messages say before the key, as "settings." or "faintspot.toml: ".
    table : mapping
    known, required : names
    what : str
        What its keys are: "key", "table".

    Raises
    ------
    InputError
        It says which key was probably meant.
    """
    for key in table:
        check_known(prefix, key, known, what)
    for key in required:
        if key not in table:
            raise InputError(f"{prefix}{key}: expected a value, found none")


def check_known(prefix: str, name: str, known: Iterable[str], what: str = "key") -> None:
    """Refuse a name that is not among those that are known, and say which one was probably meant.

    Raises
    ------
    InputError
        As "settings.noise_sdt: unknown key; did you mean noise_std?".
    """
    names = list(known)
    if name not in names:
        close = difflib.get_close_matches(name, names, 1)
        hint = f"did you mean {close[0]}?" if close else f"known: {', '.join(names)}"
        raise InputError(f"{prefix}{name}: unknown {what}; {hint}")


def checked_table(where: str, value: Any) -> dict[str, Any]:
    """Return a value that must be a table.

    Raises
    ------
    InputError
        When it is something else; it names `where` it is.
    """
    if not isinstance(value, dict):
        raise InputError(f"{where}: expected a table, got {value!r}")
    return value
