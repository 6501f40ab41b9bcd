"""Declared options with bounds, unit and meaning.

The declaration is the single source of checks, values per sub-aperture, configuration files, command-line
options and the tables of the documentation.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields
from types import MappingProxyType
from typing import Any, ClassVar, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from faintspot.base.checks import numbers_between, one_of, strings_of
from faintspot.base.errors import InputError

_Value = TypeVar("_Value")

AUTO = "auto"
REQUIRED: Any = MISSING
"""Default of an option that must be given."""
FLAG, TEXT, TEXTS = "true or false", "a text", "a list of texts"
LIST, NUMBER_OR_LIST = "a list of numbers", "a number or a list of numbers"
_MIXED = 'expected "auto" for the whole sensor or numbers for all sub-apertures, got both'


@dataclass(frozen=True)
class Option:
    """Declaration of an option.

    Parameters
    ----------
    meaning : str
        One or two sentences for documentation and help texts.
    unit : str
        Unit such as "px" or "e-"; empty for pure numbers.
    low, high : float
        Bounds of a number.
    low_open : bool
        Whether `low` itself is excluded.
    whole : bool
        Whether it must be a whole number.
    choices : tuple of str
        Allowed names, instead of a number.
    per_subaperture : bool
        Whether it may differ between sub-apertures.
    automatic : bool
        Whether it may be "auto": chosen from flux, camera and spot.
    optional : bool
        Whether it may be None: not used, or chosen automatically.
    group : str
        Table of a file in which the option stands, where a class describes several.
    kind : str
        FLAG, TEXT, TEXTS, LIST or NUMBER_OR_LIST, instead of a number or a name.
    check : callable, optional
        Function of name and value that returns the checked value, or raises InputError.
    """

    meaning: str = ""
    unit: str = ""
    low: float = -math.inf
    high: float = math.inf
    low_open: bool = False
    whole: bool = False
    choices: tuple[str, ...] = ()
    per_subaperture: bool = True
    automatic: bool = False
    optional: bool = False
    group: str = ""
    kind: str = ""
    check: Callable[[str, Any], Any] | None = None

    def checked(self, name: str, value: object) -> Any:
        """Return the checked value; scalars become plain Python values, sequences read-only arrays.

        Raises
        ------
        InputError
            If the declaration does not allow it.
        """
        if isinstance(value, PerSubaperture) and self.per_subaperture:
            return self._checked_each(name, value)
        if value is None and self.optional:
            return None
        if self.automatic and isinstance(value, str) and value == AUTO:
            return AUTO
        if self.check is not None:
            return self.check(name, value)
        if self.kind:
            return self._checked_kind(name, value)
        if self.choices:
            return self._checked_names(name, value)
        array = self._checked_numbers(name, value)
        if array.ndim == 0:
            return array.item()
        if array.ndim > 1 or not self.per_subaperture:
            several = " or one per sub-aperture" if self.per_subaperture else ""
            raise InputError(f"expected a number{several}, got shape {array.shape}", name=name)
        return _locked(array.copy())

    def _checked_kind(self, name: str, value: Any) -> Any:
        """Return a flag or a text, or several texts or numbers as a tuple."""
        if self.kind == TEXTS:
            return tuple(one_of(name, text, self.choices or (text,)) for text in strings_of(name, value))
        if self.kind in (FLAG, TEXT):
            if not isinstance(value, bool if self.kind == FLAG else str) or value == "":
                raise InputError(f"expected {self.kind}", name=name, value=value)
            return value
        if self.kind == NUMBER_OR_LIST and np.ndim(value) != 1:
            return self._checked_numbers(name, value).item()
        if np.ndim(value) != 1:
            raise InputError(f"expected {LIST}, got {value!r}", name=name)
        return tuple(self._checked_numbers(name, value).tolist()) if len(value) else ()

    def _checked_each(self, name: str, value: PerSubaperture) -> PerSubaperture:
        if None in value.others.values():
            raise InputError("expected a value for each sub-aperture listed, got none", name=name)
        others = {int(index): self.checked(name, item) for index, item in value.others.items()}
        if AUTO in others.values() or (others and value.default == AUTO):
            raise InputError(_MIXED, name=name)
        return PerSubaperture(self.checked(name, value.default), MappingProxyType(others))

    def _checked_names(self, name: str, value: Any) -> Any:
        if isinstance(value, str) or not self.per_subaperture:
            return one_of(name, value, self.choices)
        try:
            names = [one_of(name, item, self.choices) for item in value]
        except TypeError:
            names = []
        if not names:
            raise InputError("expected one value or one per sub-aperture", name=name, value=value)
        return _locked(np.array(names))

    def _checked_numbers(self, name: str, value: object) -> NDArray[Any]:
        try:
            return numbers_between(
                name, value, self.low, self.high, integer=self.whole, low_open=self.low_open
            )
        except InputError as error:
            if self.automatic and isinstance(value, str):
                raise InputError('expected a number or "auto"', name=name, value=value) from None
            if self.automatic and isinstance(value, list | tuple) and AUTO in value:
                raise InputError(_MIXED, name=name) from None
            raise error from None


def option(default: _Value, meaning: str, **bounds: Any) -> _Value:
    """Declare an option of a dataclass derived from `Options`; `bounds` are the other fields of `Option`.

    Examples
    --------
    >>> from dataclasses import dataclass
    >>> from faintspot.slopes.estimators import Estimator, option
    >>> @dataclass(frozen=True, eq=False, kw_only=True)
    ... class Power(Estimator):
    ...     name = "power"
    ...     power: float = option(1.5, "Power of each pixel's signal.", low=1.0, high=4.0)
    >>> Power(power=9.0)
    Traceback (most recent call last):
        ...
    faintspot.base.errors.InputError: power = 9: expected a number from 1 to 4
    """
    bounds.setdefault("optional", default is None)
    declared: _Value = field(default=default, metadata={"option": Option(meaning, **bounds)})
    return declared


def setting(default: _Value, meaning: str = "", **bounds: object) -> _Value:
    """Declare an option that has one value for the whole sensor; see `option`."""
    return option(default, meaning, per_subaperture=False, **bounds)


def number(default: _Value, low: float, high: float, meaning: str = "", **bounds: object) -> _Value:
    """Declare a number from `low` to `high`, or None if that is its default; see `option`."""
    return setting(default, meaning, low=low, high=high, **bounds)


@dataclass(frozen=True)
class PerSubaperture:
    """Value for each sub-aperture of a sensor of any size: a default, and other values for some of them."""

    default: Any
    others: Mapping[int, Any]

    def __getitem__(self, index: int) -> Any:
        """Return the value of sub-aperture `index`."""
        return self.others.get(int(index), self.default)

    def __reduce__(self) -> tuple[Any, ...]:
        return PerSubaperture, (self.default, dict(self.others))  # a read-only mapping cannot be pickled


Value = float | str | NDArray[np.generic] | PerSubaperture | None
"""An option that may differ between sub-apertures: one value, an array, or a default and others."""


@dataclass(frozen=True, eq=False)
class Options:
    """Base class of frozen dataclasses whose fields are declared by `option` and checked on creation.

    Raises
    ------
    InputError
        If a value is out of range, NaN or of the wrong type, or arrays have different lengths.
    """

    table: ClassVar[str] = ""
    """Table of a configuration file that holds the options; messages begin with it."""

    def __init_subclass__(cls, table: str = "", **named: object) -> None:
        super().__init_subclass__(**named)
        cls.table = table or cls.table

    def __post_init__(self) -> None:
        prefix = self.table and f"{self.table}."
        for name, declared in self.declared().items():
            object.__setattr__(self, name, declared.checked(f"{prefix}{name}", getattr(self, name)))
        check_lengths(self)

    def __eq__(self, other: object) -> bool:
        if type(other) is not type(self):
            return NotImplemented
        return all(_same(getattr(self, name), getattr(other, name)) for name in self.declared())

    __hash__ = None  # type: ignore[assignment]

    @classmethod
    def declared(cls) -> dict[str, Option]:
        """Return the declarations by name."""
        return {item.name: item.metadata["option"] for item in fields(cls) if "option" in item.metadata}

    @classmethod
    def defaults(cls) -> dict[str, Any]:
        """Return the default of each option."""
        return {item.name: item.default for item in fields(cls) if "option" in item.metadata}

    def chosen(self) -> dict[str, Any]:
        """Return the options whose values are not the defaults."""
        defaults = self.defaults()
        return {
            name: getattr(self, name)
            for name in self.declared()
            if not _same(getattr(self, name), defaults[name])
        }

    def default_of(self, name: str, pixels: int) -> float:
        """Return the value used in place of None for windows of `pixels` pixels; NaN if there is none."""
        return math.nan

    def values(self, name: str, n_subapertures: int, pixels: int) -> NDArray[Any]:
        """Return one value per sub-aperture, with defaults filled in.

        Raises
        ------
        InputError
            If the values are for another number of sub-apertures.
        """
        value = getattr(self, name)
        if isinstance(value, np.ndarray):
            if len(value) != n_subapertures:
                raise InputError(
                    f"expected {n_subapertures} values, one per sub-aperture, got {len(value)}", name=name
                )
            return value
        if isinstance(value, PerSubaperture):
            beyond = [index for index in value.others if index >= n_subapertures]
            if beyond:
                raise InputError(
                    f"{name}: sub-aperture {beyond[0]} does not exist; there are {n_subapertures}"
                )
            default = self.default_of(name, pixels) if value.default is None else value.default
            return np.array([value.others.get(i, default) for i in range(n_subapertures)])
        return np.full(n_subapertures, self.default_of(name, pixels) if value is None else value)

    def replaced(self, changes: Mapping[str, object], where: Any = None) -> Self:
        """Return a copy with some values changed, everywhere or in some sub-apertures (indices or a mask).

        Raises
        ------
        InputError
            If a name is unknown, a value is invalid, or an index is out of range.
        """
        values = {name: getattr(self, name) for name in self.declared()}
        for name, value in changes.items():
            if name not in values:
                raise InputError(f"{name}: expected one of {', '.join(values)}")
            values[name] = value if where is None else self._changed_at(name, _indices(where), value)
        return type(self)(**values)

    def _changed_at(self, name: str, selected: NDArray[np.int64], value: object) -> Any:
        """Replace the values of the selected sub-apertures."""
        declared, old = self.declared()[name], getattr(self, name)
        if not declared.per_subaperture:
            raise InputError(f"{name}: expected one value for the whole sensor, not one for `where`")
        new = declared.checked(name, value)
        several = isinstance(new, np.ndarray)
        if several and len(new) != len(selected):
            raise InputError(
                f"{name}: expected one value or {len(selected)}, as many as `where`, got {len(new)}"
            )
        if isinstance(old, np.ndarray):
            if selected.max(initial=-1) >= len(old):
                raise InputError(f"where: sub-aperture {selected.max()} does not exist; there are {len(old)}")
            result = old.astype(np.result_type(old, np.asarray(new)))
            result[selected] = new
            return result
        others = dict(old.others) if isinstance(old, PerSubaperture) else {}
        values = new.tolist() if several else [new] * len(selected)
        others.update({int(index): item for index, item in zip(selected, values, strict=True)})
        return PerSubaperture(old.default if isinstance(old, PerSubaperture) else old, others)


def check_lengths(*parts: Options) -> None:
    """Raise an error for arrays of different lengths among the options of one sensor.

    Raises
    ------
    InputError
        If there are any.
    """
    lengths = {
        name: len(value)
        for part in parts
        for name, declared in part.declared().items()
        if declared.per_subaperture and isinstance(value := getattr(part, name), np.ndarray)
    }
    if len(set(lengths.values())) > 1:
        sizes = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise InputError(f"settings: expected arrays of one length, got {sizes}")


def is_auto(value: object) -> bool:
    """Return whether an option is chosen automatically."""
    return isinstance(value, str) and value == AUTO


def _same(a: object, b: object) -> bool:
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        return isinstance(a, np.ndarray) and isinstance(b, np.ndarray) and np.array_equal(a, b)
    return bool(a == b)


def _indices(where: int | Sequence[int] | NDArray[Any]) -> NDArray[np.int64]:
    """Return sub-aperture numbers from an int, a sequence of int or a boolean mask."""
    array = np.atleast_1d(np.asarray(where))
    if array.dtype == np.bool_:
        array = np.flatnonzero(array)
    if array.size == 0:
        return np.empty(0, np.int64)
    return numbers_between("where", array, 0, 2**31, integer=True).astype(np.int64)


def _locked(array: NDArray[np.generic]) -> NDArray[Any]:
    array.flags.writeable = False
    return array
