"""Report made of sections: one HTML text without external files."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import TypeAlias

from faintspot.base.errors import InputError, MissingExtraError
from faintspot.base.files import derived, write_atomically
from faintspot.base.report.figure_data import FigureWithData, data_uri
from faintspot.base.version import __version__

POSITIONS = "Positions are in pixels from each sub-aperture’s centre, x along columns, y along rows."
"""Remark for the foot of a page."""


@dataclass(frozen=True)
class TableCell:
    """Content of a table's cell with more than text."""

    text: str = ""
    badge: str = ""
    """Outcome, on a coloured background."""
    small: str = ""
    """Small text below."""


@dataclass(frozen=True)
class Table:
    """A table; one without rows is left out of a page.

    Attributes
    ----------
    header : sequence of str
    rows : sequence of sequences of str or TableCell
    caption : str
    words : bool
        Whether the last column is prose.
    prose : bool
        Whether all columns are prose.
    csv : tuple of str, optional
        Name of a file and its text, for readers to save.
    """

    header: Sequence[str]
    rows: Sequence[Sequence[str | TableCell]]
    caption: str = ""
    words: bool = False
    prose: bool = False
    csv: tuple[str, str] | None = None

    def __len__(self) -> int:
        return len(self.rows)


Part: TypeAlias = "str | Sequence[str] | Table | FigureWithData"
"""Part of a section: a paragraph, a list of points, a table or a figure."""


@dataclass(frozen=True)
class Section:
    """A section of a page.

    Attributes
    ----------
    name : str
        Name for links.
    title : str
    parts : sequence of Part
    missing : str
        Reason why something is missing from it.
    code : str
        Text of a file, shown after a click.
    """

    name: str
    title: str
    parts: Sequence[Part] = ()
    missing: str = ""
    code: str = ""

    @property
    def tables(self) -> list[Table]:
        """Its tables."""
        return [part for part in self.parts if isinstance(part, Table)]

    @property
    def figures(self) -> list[FigureWithData]:
        """Its figures."""
        return [part for part in self.parts if isinstance(part, FigureWithData)]


@dataclass(frozen=True)
class Report:
    """A page: title, warnings, and sections."""

    title: str
    facts: Mapping[str, str]
    sections: Sequence[Section]
    warnings: Sequence[str] = ()
    warnings_title: str = "What to look at first"
    remark: str = ""
    """Remark for the foot of the page about units and signs."""

    def html(self) -> str:
        """Return the page as HTML: self-contained, without scripts.

        Raises
        ------
        MissingExtraError
            When matplotlib or jinja2 is not installed.
        """
        try:
            import jinja2
        except ImportError:
            raise MissingExtraError("jinja2", "report", "Making a report page") from None
        environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
        environment.filters["unbroken"] = _unbroken
        template = environment.from_string(_template("page.html"))
        values = {"style": _template("page.css"), "version": __version__, "data_uri": data_uri}
        return template.render(page=self, **values)

    def write(self, path: str | Path) -> list[Path]:
        """Write the page and a folder beside it with each figure that has data: PNG, SVG and numbers as CSV.

        Returns
        -------
        list of Path
            The page, then the figures' files.

        Raises
        ------
        InputError
            When a file cannot be written.
        MissingExtraError
            When matplotlib or jinja2 is not installed.
        """
        path = Path(path)
        write_atomically(path, self.html())
        folder = derived(path, "-figures")
        try:
            folder.mkdir(exist_ok=True)
        except OSError as error:
            raise InputError(f"{folder}: {error.strerror}; choose another folder") from None
        contents = {
            folder / f"{figure.name}.{ending}": content
            for section in self.sections
            for figure in section.figures
            if figure.header
            for ending, content in figure.files.items()
        }
        for file, content in contents.items():
            write_atomically(file, content)
        return [path, *contents]


def configuration_section(text: str, name: str = "Configuration") -> Section:
    """Return the section that shows a configuration or a specification; "" if unknown."""
    missing = "" if text.strip() else f"The {name.lower()} of this run is not known."
    identifier = "-".join(re.findall(r"\w+", name.lower()))
    return Section(identifier, name, code=text.strip(), missing=missing)


def _unbroken(text: str) -> str:
    """Keep values with their errors and units, and the ends of intervals, on one line."""
    return re.sub(
        r"(?:^| )± | to (?=[+−\d])|(?<=\d) (?=%|e[-⁻])",
        lambda found: found.group().replace(" ", "\u00a0"),
        text,
    )


def _template(name: str) -> str:
    return files("faintspot.base.report").joinpath("templates", name).read_text(encoding="utf-8")
