"""Dataclass fields with an allowed range of numbers."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from faintspot.base.checks import number_between, numbers_between
from faintspot.base.errors import InputError

LIST = "a list of numbers"
NUMBER_OR_LIST = "a number or a list of numbers"


@dataclass(frozen=True)
class _Permitted:
    """Allowed values of a field."""

    low: float
    high: float
    low_open: bool
    whole: bool
    several: str

    def checked(self, where: str, value: Any) -> Any:
        """Return the value; a list as a tuple."""
        if self.several == LIST or (self.several and np.ndim(value) == 1):
            if np.ndim(value) != 1:
                raise InputError(f"{where}: expected {LIST}, got {value!r}")
            if not len(value):
                return ()
            return tuple(numbers_between(where, value, self.low, self.high, low_open=self.low_open).tolist())
        number = number_between(where, value, self.low, self.high, integer=self.whole, low_open=self.low_open)
        return int(number) if self.whole else number


def number(
    default: Any,
    low: float,
    high: float,
    *,
    low_open: bool = False,
    whole: bool = False,
    several: str = "",
) -> Any:
    """Declare a field that holds a number from `low` to `high`, or None if that is its default.

    Parameters
    ----------
    default : number, tuple or None
    low, high : float
    low_open : bool
        Whether `low` itself is refused.
    whole : bool
    several : str
        `LIST` or `NUMBER_OR_LIST` for a field that holds several.
    """
    return field(default=default, metadata={"permitted": _Permitted(low, high, low_open, whole, several)})


def checked_section(name: str, section: Any, kind: type[Any]) -> Any:
    """Return a dataclass with the numbers in its fields checked and its lists as tuples.

    Parameters
    ----------
    name : str
        What messages call it.
    section : object
    kind : type
        What it must be.

    Raises
    ------
    InputError
        When it is of another kind or a value is out of its range.
    """
    if not isinstance(section, kind):
        raise InputError(f"{name}: expected {kind.__name__}, got {type(section).__name__}")
    checked = {
        item.name: item.metadata["permitted"].checked(f"{name}.{item.name}", getattr(section, item.name))
        for item in fields(section)
        if "permitted" in item.metadata and getattr(section, item.name) is not None
    }
    return replace(section, **checked)
