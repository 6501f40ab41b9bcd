"""The texts of reports: TOML files named `texts.toml`, in the packages whose modules fill them in."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from functools import cached_property, reduce
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from faintspot.base.report.figure_data import FigureWithData
from faintspot.base.report.page import Part, Section, Table, TableCell
from faintspot.base.report.words import NOTHING, LeftOut, Words

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Texts:
    """Texts of a package by dotted names, with values put in where they have {names}.

    A text is a string or a list of sentences; one that begins with a semicolon goes on with the one before.
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
        figure: Figure,
        rows: Sequence[Sequence[object]] = (),
        columns: Sequence[str] = (),
        /,
        **values: object,
    ) -> FigureWithData:
        """Return a figure with its title and caption, and the columns of its numbers."""
        title, caption = (self(f"{name}.{part}", **values) for part in ("title", "caption"))
        short = name.partition(".")[0]
        return FigureWithData(short, title, caption, figure, columns or self[name].get("columns", ()), rows)

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
