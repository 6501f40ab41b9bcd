"""Tables of a configuration file (faintspot.toml): read, checked and written, preserving other content."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any

import numpy as np

from faintspot.base.config.options import PerSubaperture
from faintspot.base.errors import InputError
from faintspot.base.files import write_atomically
from faintspot.base.toml_files import check_keys, checked_table, parse_file, read_text

TABLES = (
    "layout",
    "calibration",
    "estimator",
    "settings",
    "psf",
    "score",
    "laser",
    "promise",
    "loop",
    "control",
)


def read_tables(path: str | Path) -> dict[str, dict[str, Any]]:
    """Read the tables of a configuration file as plain dictionaries.

    Raises
    ------
    InputError
        If the file cannot be read, is not TOML, or has an unknown table.
    """
    path = Path(path)
    maker = f"`faintspot layout FRAME -o {path.name}` makes one"
    document = parse_file(path, if_missing=maker)
    check_keys(f"{path}: ", document, TABLES, what="table")
    return {name: checked_table(f"{path}: {name}", values) for name, values in document.items()}


def table_of(path: str | Path, document: Mapping[str, dict[str, Any]], name: str) -> dict[str, Any]:
    """Return a required table.

    Raises
    ------
    InputError
        If it is missing.
    """
    if name not in document:
        raise InputError(f"{path}: expected a table [{name}], found {', '.join(document) or 'none'}")
    return document[name]


@contextlib.contextmanager
def errors_of_table(path: str | Path, name: str) -> Iterator[None]:
    """Prefix errors with the file and the table in which they occur."""
    try:
        yield
    except InputError as error:
        text = str(error)
        names_table = text.startswith(tuple(f"{table}{mark}" for table in TABLES for mark in ".: "))
        raise InputError(f"{path}: {'' if names_table else f'{name}.'}{text}") from None


def check_fields(name: str, kind: type, values: Mapping[str, Any]) -> None:
    """Raise an error for keys that are not fields of a dataclass, and for missing required fields.

    Raises
    ------
    InputError
        If there are any.
    """
    required = [f.name for f in fields(kind) if f.default is MISSING]
    check_keys(f"{name}.", values, [f.name for f in fields(kind)], required=required)


def chosen_fields(item: Any) -> dict[str, Any]:
    """Return the fields of a dataclass whose values are not the defaults."""
    values = {}
    for f in fields(item):
        value = getattr(item, f.name)
        at_default = f.default is not MISSING and not isinstance(value, np.ndarray) and value == f.default
        if value is not None and not at_default:
            values[f.name] = value
    return values


def save_tables(path: str | Path, tables: Mapping[str, Mapping[str, Any] | None]) -> None:
    """Write tables into a configuration file; None removes a table. Other tables and comments are preserved.

    Raises
    ------
    InputError
        If the file exists and is not TOML, or cannot be written.
    """
    import tomlkit
    from tomlkit.exceptions import TOMLKitError

    path = Path(path)
    try:
        document = tomlkit.parse(read_text(path)) if path.exists() else tomlkit.document()
    except (TOMLKitError, RecursionError) as error:
        raise InputError(f"{path}: not a TOML file: {error}") from None
    for name, values in tables.items():
        if values is None:
            document.pop(name, None)
        else:
            document[name] = _toml_table(values)
    write_atomically(path, tomlkit.dumps(document))


def tables_as_text(tables: Mapping[str, Mapping[str, Any]]) -> str:
    """Return tables as TOML text."""
    import tomlkit

    document = tomlkit.document()
    for name, values in tables.items():
        document[name] = _toml_table(values)
    return tomlkit.dumps(document)


def per_subaperture(where: str, value: Any) -> Any:
    """Return { default = 2.5, 4 = 3.0 } as values of some sub-apertures and a default for the others.

    Raises
    ------
    InputError
        If a key is neither "default" nor a number.
    """
    if not isinstance(value, dict):
        return value
    others = {}
    for index, item in value.items():
        if index == "default":
            continue
        if not index.isdecimal():
            raise InputError(f"{where}.{index}: expected default or the number of a sub-aperture")
        others[int(index)] = item
    return PerSubaperture(value.get("default"), others)


def is_map(value: Any) -> bool:
    """Return whether a value is an image rather than rows of positions."""
    return (
        isinstance(value, np.ndarray) and value.ndim == 2 and (value.shape[1] != 2 or value.dtype.kind != "i")
    )


def _toml_table(values: Mapping[str, Any]) -> Any:
    import tomlkit

    table = tomlkit.table()
    for key, value in values.items():
        table[key] = _toml_value(value)
    return table


def _toml_value(value: Any) -> Any:
    import tomlkit

    if isinstance(value, PerSubaperture):
        inline = tomlkit.inline_table()
        if value.default is not None:
            inline["default"] = value.default
        for index, item in value.others.items():
            inline[str(index)] = item
        return inline
    if isinstance(value, np.ndarray):
        # Rows are positions in pixels: six decimals are sufficient and readable.
        rows = np.round(value, 6).tolist() if value.ndim == 2 else value.tolist()
        array = tomlkit.array()
        array.extend(rows)
        return array.multiline(value.ndim == 2)
    return list(value) if isinstance(value, tuple) else value
