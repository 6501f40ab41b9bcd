"""Tables of a configuration file (faintspot.toml), presets of options, and changes written as NAME=VALUE."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any, Self, TypeVar

import numpy as np

from faintspot.base.errors import InputError, errors_within
from faintspot.base.files import write_atomically
from faintspot.base.options import Options, PerSubaperture
from faintspot.base.text_files import check_keys, checked_table, parse_file, read_text

PRESETS = ("accurate", "fast")

FEW_KEPT = 32
"""Pixels whose centre of gravity does not depend on the shallow background, which converges last."""
_DENOISING: dict[str, dict[str, object]] = {
    "accurate": {"tolerance": 2.5e-3, "max_iterations": 480},
    "fast": {"tolerance": 0.0, "max_iterations": 8},
}
_ACCURATE_OF_FEW = {"tolerance": 0.0, "max_iterations": 24}


def of_denoising(preset: str, *, keeps_few: bool = False) -> dict[str, Any]:
    """Return tolerance and iteration limit of the total-variation denoising.

    `keeps_few`: at most `FEW_KEPT` pixels are kept of the image.
    """
    return _ACCURATE_OF_FEW if preset == "accurate" and keeps_few else _DENOISING[preset]


TABLES = (
    "layout",
    "calibration",
    "estimator",
    "settings",
    "psf",
    "weights",
    "laser",
    "promise",
    "loop",
    "control",
)


class Tables:
    """Tables of a configuration file, read once.

    Parameters
    ----------
    path : path
        The file; messages name it, and files that its tables name are beside it.
    tables : mapping, optional
        Its content, if the file is not to be read.

    Raises
    ------
    InputError
        If the file cannot be read, is not TOML, or has an unknown table.
    """

    def __init__(self, path: str | Path, tables: Mapping[str, object] | None = None) -> None:
        self.path = path = Path(path)
        if tables is None:
            tables = parse_file(path, if_missing=f"`faintspot layout FRAME -o {path.name}` makes one")
        check_keys(f"{path}: ", tables, TABLES, what="table")
        self.tables = {name: checked_table(f"{path}: {name}", values) for name, values in tables.items()}

    def __contains__(self, name: str) -> bool:
        return name in self.tables

    def __getitem__(self, name: str) -> dict[str, Any]:
        """Return a required table.

        Raises
        ------
        InputError
            If it is missing.
        """
        if name not in self.tables:
            raise InputError(
                f"{self.path}: expected a table [{name}], found {', '.join(self.tables) or 'none'}"
            )
        return self.tables[name]

    def part(self, kind: type[Part]) -> Part:
        """Return the object that a required table describes."""
        return kind.from_table(self[kind.table], self.path)


@dataclass(frozen=True, eq=False)
class ConfigurationTable(Options):
    """Options that are a table of a configuration file."""

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read the table of a configuration file (TOML)."""
        return Tables(path).part(cls)

    @classmethod
    def from_table(cls, values: Mapping[str, object], path: Path | None = None) -> Self:
        """Make the object that a table describes; messages name `path`, if there is one.

        Raises
        ------
        InputError
            If a key is unknown, or a value is missing or invalid.
        """
        required = [item.name for item in fields(cls) if MISSING is item.default is item.default_factory]
        with errors_within(path):
            check_keys(f"{cls.table}.", values, [item.name for item in fields(cls)], required=required)
            return cls(**values)

    def to_table(self) -> dict[str, Any]:
        """Return the table: the fields whose values are not the defaults."""
        return {
            item.name: value
            for item in fields(self)
            if (value := getattr(self, item.name)) is not None
            and (isinstance(value, np.ndarray) or item.default is MISSING or value != item.default)
        }

    def save(self, path: str | Path) -> None:
        """Write the table of a configuration file (TOML); preserve other tables."""
        save_tables(path, {self.table: self.to_table()})


Part = TypeVar("Part", bound=ConfigurationTable)


def save_tables(path: str | Path, tables: Mapping[str, Mapping[str, object] | None]) -> None:
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


def tables_as_text(tables: Mapping[str, object]) -> str:
    """Return tables, and values outside of them, as TOML text."""
    import tomlkit

    document = tomlkit.document()
    for name, values in tables.items():
        document[name] = _toml_table(values) if isinstance(values, Mapping) else _toml_value(values)
    return tomlkit.dumps(document)


def per_subaperture(where: str, value: object) -> object:
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
            raise InputError("expected default or the number of a sub-aperture", name=f"{where}.{index}")
        others[int(index)] = item
    return PerSubaperture(value.get("default"), others)


def is_map(value: object) -> bool:
    """Return whether a value is an image rather than rows of positions."""
    return (
        isinstance(value, np.ndarray) and value.ndim == 2 and (value.shape[1] != 2 or value.dtype.kind != "i")
    )


def _toml_table(values: Mapping[str, object]) -> object:
    import tomlkit

    table = tomlkit.table()
    for key, value in values.items():
        table[key] = _toml_value(value)
    return table


def _toml_value(value: object) -> object:
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
    return np.array(value).tolist() if isinstance(value, tuple) else value


_MOST_SUBAPERTURES = 1_000_000
_WORDS = {"none": None, "true": True, "false": False}


def parse_changes(changes: Sequence[str], *, texts: Sequence[str] = ()) -> dict[str, Any]:
    """Return new values by name from texts such as "noise_std=2.5" and "keep_brightest=20".

    Values are numbers, true, false, none, text, or a comma-separated list with one of them for each
    sub-aperture; those of names in `texts` stay text. Names are not checked here, but by the owner of the
    settings.

    Raises
    ------
    InputError
        If a text is not NAME=VALUE, a name is repeated, or a value is empty.
    """
    values: dict[str, object] = {}
    for text in changes:
        name, equals, value = (part.strip() for part in text.partition("="))
        if not (name and equals):
            raise InputError(f"{text!r}: expected NAME=VALUE, such as search_range_px=2.5")
        if name in values:
            raise InputError(f"{name}: expected one new value, got two")
        items = [item.strip() for item in value.split(",")]
        if "" in items:
            raise InputError(f"{text!r}: expected a value after '=', or several separated by commas")
        parsed = [_parsed_value(item) for item in items]
        values[name] = value if name in texts else parsed[0] if len(parsed) == 1 else parsed
    if not values:
        raise InputError("settings: expected at least one NAME=VALUE, such as search_range_px=2.5, got none")
    return values


def parse_ranges(text: str, name: str = "sub-apertures") -> list[int]:
    """Return numbers from text such as "4,5,10-20"; ranges include both ends.

    The order is kept, duplicates are removed. Messages begin with `name`.

    Raises
    ------
    InputError
        If the text has another form.
    """
    numbers: dict[int, None] = {}
    for part in text.split(","):
        ends = [end.strip() for end in part.split("-")]
        if len(ends) > 2 or not all(end.isascii() and end.isdecimal() and len(end) < 10 for end in ends):
            raise InputError(
                f"{name} {text!r}: expected numbers and ranges such as 4,5,10-20, got {part.strip()!r}"
            )
        first, last = int(ends[0]), int(ends[-1])
        if last < first:
            raise InputError(f"{name} {text!r}: expected an increasing range, got {part.strip()!r}")
        if last >= _MOST_SUBAPERTURES:
            raise InputError(f"{name} {text!r}: expected numbers below {_MOST_SUBAPERTURES}")
        numbers.update(dict.fromkeys(range(first, last + 1)))
    return list(numbers)


def _parsed_value(text: str) -> object:
    if text.lower() in _WORDS:
        return _WORDS[text.lower()]
    for number in (int, float):
        try:
            return number(text)
        except ValueError:
            continue
    return text
