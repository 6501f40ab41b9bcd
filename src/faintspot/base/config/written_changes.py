"""Changes of settings in text form: NAME=VALUE, and lists of sub-apertures.

Imports are kept small, for commands that only forward changes to a running engine.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from faintspot.base.errors import InputError

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
