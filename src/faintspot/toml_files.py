"""TOML files: read with errors in one line, unknown names refused with the one that was meant."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from faintspot.errors import InputError

if TYPE_CHECKING:
    import tomlkit


def parse_file(path: str | Path, *, if_missing: str = "") -> tomlkit.TOMLDocument:
    """Read a TOML file; `.unwrap()` gives plain dictionaries, the document itself keeps the comments.

    Parameters
    ----------
    path : path
    if_missing : str
        What to say beside "no such file", as who makes one.

    Raises
    ------
    InputError
        When the file cannot be read or is not TOML.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except FileNotFoundError:
        raise InputError(f"{path}: no such file{if_missing and f'; {if_missing}'}") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a TOML file: it is not UTF-8 text") from None
    return parse_text(text, str(path))


def parse_text(text: str, where: str) -> tomlkit.TOMLDocument:
    """Read TOML text; `where` it was found is named in messages.

    Raises
    ------
    InputError
        When it is not TOML.
    """
    import tomlkit  # here: layouts and calibrations are made without any file, too
    from tomlkit.exceptions import TOMLKitError

    try:
        return tomlkit.parse(text)
    except TOMLKitError as error:
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
