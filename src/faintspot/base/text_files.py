"""TOML and JSON texts: read with one-line errors and suggestions for unknown names; JSON without NaN."""

import difflib
import json
import math
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from faintspot.base.errors import InputError
from faintspot.base.files import read_bytes

_MOST_BYTES = 1 << 22  # a layout of 10,000 sub-apertures needs a tenth of it


def read_text(path: str | Path, *, if_missing: str = "") -> str:
    """Read the text of a TOML file.

    Parameters
    ----------
    path : path
    if_missing : str
        Text added to "no such file", for example the command that makes it.

    Raises
    ------
    InputError
        If the file cannot be read, is too large or is not UTF-8.
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
    """Read a TOML file; parameters and errors are those of `read_text` and `parse_text`."""
    return parse_text(read_text(path, if_missing=if_missing), str(path))


def parse_text(text: str, where: str) -> dict[str, Any]:
    """Read TOML text; messages name its origin, `where`.

    Raises
    ------
    InputError
        If it is not TOML.
    """
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise InputError(f"{where}: not a TOML file: nested too deeply") from None
    except ValueError as error:  # also raised for numbers that Python cannot read
        raise InputError(f"{where}: not a TOML file: {str(error).splitlines()[0]}") from None


def check_keys(
    prefix: str,
    table: Mapping[str, object],
    known: Iterable[str],
    *,
    required: Iterable[str] = (),
    what: str = "key",
) -> None:
    """Raise an error for a table with an unknown key, or without a required one.

    Parameters
    ----------
    prefix : str
        Text before the key in messages, such as "settings." or "faintspot.toml: ".
    table : mapping
    known, required : names
    what : str
        Kind of its keys: "key", "table".

    Raises
    ------
    InputError
        If a key is unknown or missing; the message suggests the most similar key.
    """
    for key in table:
        check_known(prefix, key, known, what)
    for key in required:
        if key not in table:
            raise InputError("expected a value, found none", name=f"{prefix}{key}")


def check_known(prefix: str, name: str, known: Iterable[str], what: str = "key") -> None:
    """Raise an error for an unknown name, and suggest the most similar known one.

    Raises
    ------
    InputError
        Such as "settings.noise_sdt: unknown key; did you mean noise_std?".
    """
    names = list(known)
    if name not in names:
        close = difflib.get_close_matches(name, names, 1)
        hint = f"did you mean {close[0]}?" if close else f"known: {', '.join(names)}"
        raise InputError(f"unknown {what}; {hint}", name=f"{prefix}{name}")


def checked_table(where: str, value: object) -> dict[str, Any]:
    """Return a value that must be a table.

    Raises
    ------
    InputError
        If it is something else; the message begins with `where`.
    """
    if not isinstance(value, dict):
        raise InputError(f"{where}: expected a table, got {value!r}")
    return value


def to_json(value: object, *, indent: int | None = None, exact: bool = False) -> str:
    """Return JSON text that every reader accepts.

    Parameters
    ----------
    value
        Mappings, sequences, NumPy arrays and numbers, paths and plain values.
    indent : int, optional
    exact : bool
        Whether to refuse values that JSON lacks. Otherwise numbers that are not finite become null (unknown),
        and other objects text.

    Raises
    ------
    ValueError, TypeError
        With `exact`, for a number that is not finite, or another object.
    """
    return json.dumps(plain_values(value, exact=exact), indent=indent, allow_nan=False)


def plain_values(value: object, *, exact: bool = False) -> Any:
    """Return a value as JSON allows it; parameters and errors are those of `to_json`."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(key): plain_values(item, exact=exact) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain_values(item, exact=exact) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        if exact:
            raise ValueError(f"{value} is not a finite number")
        return None
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if exact and not isinstance(value, Path):
        raise TypeError(f"{type(value).__name__} is neither number nor text")
    return str(value)


def parse_json(text: str | bytes) -> Any:
    """Return the content of a JSON text.

    Raises
    ------
    ValueError
        If it is not JSON, holds NaN or infinity, or is nested too deeply for Python.
    """
    try:
        return json.loads(text, parse_constant=_refused)
    except RecursionError:
        raise ValueError("nested too deeply") from None


def _refused(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is not JSON")
