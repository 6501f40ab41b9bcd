"""Texts of reports: numbers with their errors in words, and the TOML files named `texts.toml`."""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from functools import cached_property, reduce
from importlib.resources import files
from string import Formatter
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from faintspot.base.report.page import FigureWithData, Part, Section, Table, TableCell
from faintspot.base.statistics import Estimate

if TYPE_CHECKING:
    from faintspot.base.report.plots import Drawing


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
    sigmas = estimate.in_sigmas
    return NOTHING if math.isnan(sigmas) else f"{signed(sigmas, digits)} σ"


_OF_NUMBERS: Mapping[str, Callable[[float, int], str]] = {
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


class Texts:
    """Texts of a package by dotted names; {names} in them are replaced by values.

    A text is a string or a list of sentences; one that begins with a semicolon continues the one before.
    A sentence with a value that is None or False is left out; True stands for no word. Formats are those of
    `Words`.

    Parameters
    ----------
    package : str
        Name of the package that has a `texts.toml`.
    """

    def __init__(self, package: str) -> None:
        self._package = package

    @cached_property
    def _tables(self) -> dict[str, Any]:
        return tomllib.loads(files(self._package).joinpath("texts.toml").read_text(encoding="utf-8"))

    def __getitem__(self, name: str) -> Any:
        """Return a text or a table as the file has it."""
        return reduce(lambda table, key: table[key], name.split("."), self._tables)

    def __call__(self, name: str, record: object = None, /, **values: object) -> str:
        """Return a text with values, and the attributes or items of a record, filled in."""
        return _filled(self[name], _Scope(values, record))

    def lines(self, name: str, record: object = None, /, **values: object) -> list[str]:
        """Return the sentences of a text, each by itself, that are not left out."""
        return [text for sentence in self[name] if (text := _filled(sentence, _Scope(values, record)))]

    def facts(self, name: str, record: object = None, /, **values: object) -> dict[str, str]:
        """Return the texts of a table that are not left out, by name."""
        every = {key: _filled(text, _Scope(values, record)) for key, text in self[name].items()}
        return {key: text for key, text in every.items() if text}

    def figure(
        self,
        name: str,
        rows: Sequence[Sequence[Drawing]],
        height: float,
        values: Mapping[str, object] = MappingProxyType({}),
        *,
        file: str = "",
        **options: Any,
    ) -> FigureWithData:
        """Return what `plot` draws, with options, and its title and caption with values."""
        title, caption = (self(f"{name}.{part}", **values) for part in ("title", "caption"))
        return FigureWithData.of(file or name.partition(".")[0], title, caption, rows, height, **options)

    def table(
        self, name: str, records: Iterable[object], columns: Sequence[str] = (), /, **values: object
    ) -> Table:
        """Return a table with its caption and the header: declared columns, then those given.

        Cells of declared columns are templates that are filled in with the attributes of each record; a
        sequence is a row of cells itself. A table with `only_known` has no columns of dashes alone. Sentences
        `about` columns that are shown follow the caption.
        """
        declared, scope = self[name], _Scope(values, None)
        cells = declared.get("columns", ())
        header = [*(_filled(column, scope) for column in cells), *columns]
        rows: list[Sequence[str | TableCell]] = [
            record
            if isinstance(record, Sequence)
            else [_cell(template, _Scope(values, record)) for template in cells.values()]
            for record in records
        ]
        if declared.get("only_known"):
            known = [n for n in range(len(header)) if n == 0 or any(row[n] != NOTHING for row in rows)]
            header, rows = [header[n] for n in known], [[row[n] for n in known] for row in rows]
        options = {key: declared[key] for key in ("words", "prose") if key in declared}
        about = [
            _filled(text, scope) for column, text in declared.get("about", {}).items() if column in header
        ]
        return Table(header, rows, " ".join([self(f"{name}.caption", **values), *about]), **options)

    def section(self, name: str, /, *parts: Part | None, missing: str = "", **values: object) -> Section:
        """Return a section: title, text and the parts that there are, or the reason why there are none."""
        declared = self[name]
        kept: list[Part] = [part for part in parts if part]
        if "text" in declared and (kept or not (missing or "missing" in declared)):
            kept = [self(f"{name}.text", **values), *kept]
        if not kept and not missing:
            missing = self(f"{name}.missing", **values) if "missing" in declared else ""
        return Section(name.rpartition(".")[2], self(f"{name}.title", **values), kept, missing)


class _Scope(dict[str, Any]):
    """Values by name; other names are those of a record's attributes or items."""

    def __init__(self, values: Mapping[str, object], record: object) -> None:
        super().__init__(values)
        self._record = record

    def __missing__(self, name: str) -> object:
        if isinstance(self._record, Mapping):
            return self._record[name]
        return getattr(self._record, name)


def _filled(text: str | Sequence[str], scope: _Scope) -> str:
    return " ".join(_sentences(text, scope, Words())).replace(" ; ", "; ")


def _sentences(text: str | Sequence[str], scope: _Scope, words: Words) -> list[str]:
    sentences = []
    for sentence in [text] if isinstance(text, str) else text:
        with suppress(LeftOut):
            sentences.append(words.vformat(sentence, (), scope))
    return sentences


def _cell(template: str | Sequence[str] | Mapping[str, str], scope: _Scope) -> str | TableCell:
    """Return a cell; a dash if it has numbers and none of them is known, or nothing at all."""
    if isinstance(template, Mapping):
        parts: dict[str, Any] = {part: _filled(text, scope) for part, text in template.items()}
        return TableCell(**parts) if next(iter(parts.values())) else NOTHING
    words = Words()
    sentences = _sentences(template, scope, words)
    is_known = any(words.known) or not words.known
    return " ".join(sentences) if sentences and is_known else NOTHING
