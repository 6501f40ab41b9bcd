"""Numbers with their errors in words, for tables and sentences."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from string import Formatter
from typing import Any

from faintspot.base.statistics import Estimate

NOTHING = "–"


def plain_number(value: float, digits: int = 3) -> str:
    """Return a number to so many digits, without an exponent up to a million."""
    return f"{float(f'{value:.{digits}g}'):g}"


def signed(value: float, digits: int = 3) -> str:
    """Return a number with its sign, a minus as long as a plus."""
    return f"{round(value, digits) + 0.0:+.{digits}f}".replace("-", "−")


def number_or_dash(value: float, digits: int = 2) -> str:
    """Return a number to so many decimals, a dash where there is none."""
    return f"{value:.{digits}f}" if math.isfinite(value) else NOTHING


def change(value: float, digits: int = 3) -> str:
    """Return a number with its sign to so many digits."""
    return f"{value:+.{digits}g}".replace("-", "−")


def significant(value: float, digits: int = 3) -> str:
    """Return a number with that many significant digits, zeros included."""
    text = f"{value:#.{digits}g}".rstrip(".")
    if "e" in text:
        text = f"{value:.0f}" if abs(value) >= 1 else f"{value:.1e}"
    return text


def percentage(fraction: float, digits: int = 1) -> str:
    """Return a fraction as per cent, without rounding small ones to 0 or nearly all to 100."""
    percent = 100.0 * fraction
    if 0 < percent < 0.1:
        return "< 0.1 %"
    if 99.9 < percent < 100:
        return "> 99.9 %"
    return f"{percent:.0f} %" if percent in (0, 100) else f"{percent:.{digits}f} %"


def in_hours(hours: float, digits: int = 1) -> str:
    """Return a duration in minutes or hours."""
    if hours < 1:
        return f"{60 * hours:.2g} min" if 60 * hours < 9.95 else f"{60 * hours:.0f} min"
    return f"{hours:.{digits}f} h" if hours < 9.95 else f"{hours:,.0f} h".replace(",", " ")


def with_error(estimate: Estimate, digits: int = 3, *, sign: bool = False, smallest: float = 0.0) -> str:
    """Return a value with its standard error, at least `smallest`, as "0.512 ± 0.004".

    The value alone where there is no error, a dash where there is no value.
    """
    if not math.isfinite(estimate.value):
        return NOTHING
    text = signed(estimate.value, digits) if sign else f"{estimate.value:.{digits}f}"
    if not math.isfinite(estimate.standard_error):
        return text
    return f"{text} ± {max(estimate.standard_error, smallest):.{digits}f}"


def with_interval(estimate: Estimate | None, digits: int = 3) -> str:
    """Return a difference with its 95 % interval, as "+0.012 (−0.004 to +0.028)"."""
    if estimate is None or math.isnan(estimate.value):
        return NOTHING
    if math.isinf(estimate.value):
        return "more than was measured" if estimate.value > 0 else "less than was measured"
    if math.isnan(estimate.low):
        return "too few for an interval"
    ends = [signed(end, digits) if math.isfinite(end) else "beyond" for end in (estimate.low, estimate.high)]
    return f"{signed(estimate.value, digits)} ({ends[0]} to {ends[1]})"


def in_sigmas(estimate: Estimate, digits: int = 1) -> str:
    """Return a value in units of its standard error, as "+3.1 σ"."""
    error = estimate.standard_error
    return f"{signed(estimate.value / error, digits)} σ" if math.isfinite(error) and error > 0 else NOTHING


_OF_NUMBERS: Mapping[str, Callable[[float, int], str]] = {
    "plain": plain_number,
    "signed": signed,
    "change": change,
    "significant": significant,
    "percent": percentage,
    "hours": in_hours,
}
_OF_ESTIMATES: Mapping[str, Callable[[Estimate, int], str]] = {
    "error": with_error,
    "interval": with_interval,
    "sigma": in_sigmas,
}


class LeftOut(Exception):
    """A value for which the sentence that has it is left out."""


class Words(Formatter):
    """Formats of texts: those of Python, and by name as in "{value:interval 3}", with or without digits.

    Numbers that are not finite are a dash, True is no word, None and False leave out the sentence.
    With "{value:not}" a sentence is there for None and False alone.

    Attributes
    ----------
    known : list of bool
        Whether each number that was formatted is finite.
    """

    def __init__(self) -> None:
        self.known: list[bool] = []

    def get_field(self, field_name: str, args: Sequence[object], kwargs: Mapping[str, object]) -> object:
        """Return the value of a field; parts of None leave out the sentence."""
        name = re.split(r"[.\[]", field_name)[0]
        if kwargs[name] is None and name != field_name:
            raise LeftOut
        return super().get_field(field_name, args, kwargs)

    def format_field(self, value: Any, format_spec: str) -> str:
        """Return a value in a format."""
        name, _, digits = format_spec.partition(" ")
        options = (int(digits),) if digits else ()
        if (value is None or value is False) != (name == "not"):
            raise LeftOut
        if value is True or name == "not":
            return ""
        if name in _OF_ESTIMATES:
            return _OF_ESTIMATES[name](value, *options)
        if isinstance(value, float):
            self.known.append(math.isfinite(value))
            if not self.known[-1]:
                return NOTHING
        if name in _OF_NUMBERS:
            return _OF_NUMBERS[name](value, *options)
        return str(format(value, format_spec))
