"""Report made of sections, with tables and figures: one HTML text without external files."""

from __future__ import annotations

import base64
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from faintspot.base import __version__
from faintspot.base.errors import MissingExtraError
from faintspot.base.files import write_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from faintspot.base.report.plots import Drawing

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


_CSS_PIXELS_PER_INCH = 100
_MEDIA_TYPES = {"png": "image/png", "svg": "image/svg+xml", "csv": "text/csv;charset=utf-8"}


@dataclass(frozen=True)
class FigureWithData:
    """A figure: drawn as SVG with its numbers to save if it has any, else as PNG.

    Attributes
    ----------
    name : str
        Base name of its files.
    title, caption : str
    figure : matplotlib Figure
    csv : str
        Its numbers as CSV; "" for images.
    rows : rows of Drawing
        Its content.
    """

    name: str
    title: str
    caption: str
    figure: Figure
    csv: str = ""
    rows: Sequence[Sequence[Drawing]] = ()

    @classmethod
    def of(
        cls,
        name: str,
        title: str,
        caption: str,
        rows: Sequence[Sequence[Drawing]],
        height: float,
        **options: Any,
    ) -> FigureWithData:
        """Draw rows of panels, pictures and maps with options of `plot`."""
        from faintspot.base.report.plots import csv_of, plot

        return cls(name, title, caption, plot(rows, height, **options), csv_of(rows), rows)

    @property
    def width(self) -> int:
        """Width in CSS pixels."""
        return round(float(self.figure.get_size_inches()[0]) * _CSS_PIXELS_PER_INCH)

    @property
    def picture(self) -> str:
        """Data URI of the picture."""
        from faintspot.base.report import plots

        return (
            data_uri("svg", plots.svg(self.figure)) if self.csv else data_uri("png", plots.png(self.figure))
        )


def data_uri(ending: str, content: bytes | str) -> str:
    """Return a file (png, svg or csv) as a data URI."""
    octets = content.encode() if isinstance(content, str) else content
    return f"data:{_MEDIA_TYPES[ending]};base64,{base64.b64encode(octets).decode('ascii')}"


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

    def write(self, path: str | Path) -> None:
        """Write the page to a file, as of `html`.

        Raises
        ------
        InputError
            When the file cannot be written.
        """
        write_atomically(path, self.html())


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
