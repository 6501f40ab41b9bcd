"""Report page made of sections: one HTML text without external files."""

from __future__ import annotations

import base64
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path

from faintspot.base.errors import InputError, MissingExtraError
from faintspot.base.files import derived, write_atomically
from faintspot.base.report.figure_data import FigureWithData
from faintspot.base.version import __version__

POSITIONS = "Positions are in pixels from each sub-aperture’s centre, x along columns, y along rows."
"""Remark for the foot of a page."""
_CSS_PIXELS_PER_INCH = 100
_MEDIA_TYPES = {"png": "image/png", "svg": "image/svg+xml", "csv": "text/csv;charset=utf-8"}


@dataclass(frozen=True)
class Badge:
    """A word on a coloured background: an outcome. `colour`: "good", "mixed", "bad" or "grey"."""

    word: str
    colour: str = "grey"


@dataclass(frozen=True)
class Cell:
    """Content of a table's cell with more than text."""

    text: str = ""
    badge: Badge | None = None
    small: str = ""
    """Small text below."""
    items: Sequence[tuple[str, str]] = ()
    """List of items: a text, and a small remark below it."""
    link: tuple[str, str] | None = None
    """Name of a section, and the text of the link to it."""


@dataclass(frozen=True)
class Table:
    """A table.

    Attributes
    ----------
    header : sequence of str
    rows : sequence of sequences of str or Cell
    caption : str
    words : bool
        Whether the last column is prose.
    prose : bool
        Whether all columns are prose.
    csv : tuple of str, optional
        Name of a file and its text, for readers to save.
    folded : str
        Line to click on to show the table; "" shows it always.
    """

    header: Sequence[str]
    rows: Sequence[Sequence[str | Cell]]
    caption: str = ""
    words: bool = False
    prose: bool = False
    csv: tuple[str, str] | None = None
    folded: str = ""

    @property
    def csv_uri(self) -> str:
        """The table's numbers as a data URI."""
        return "" if self.csv is None else data_uri("csv", self.csv[1].encode())


@dataclass(frozen=True)
class Section:
    """A section of a page.

    Attributes
    ----------
    name : str
        Name for links.
    title : str
    text : sequence of str
        Paragraphs.
    tables : sequence of Table
    figures : sequence of FigureWithData
    missing : str
        Reason why something is missing from it.
    points : sequence of str
        List below the text.
    code : str
        Text of a file, shown after a click.
    """

    name: str
    title: str
    text: Sequence[str] = ()
    tables: Sequence[Table] = ()
    figures: Sequence[FigureWithData] = ()
    missing: str = ""
    points: Sequence[str] = ()
    code: str = ""


@dataclass(frozen=True)
class Page:
    """A page: title, warnings, and sections."""

    title: str
    facts: Mapping[str, str]
    sections: Sequence[Section]
    warnings: Sequence[str] = ()
    warnings_title: str = "What to look at first"
    remark: str = ""
    """Remark for the foot of the page about units and signs."""


@dataclass(frozen=True)
class DrawnFigure:
    """A drawn figure: contents of its files by ending, png alone or png, svg and csv."""

    name: str
    title: str
    caption: str
    width: int
    """Width in CSS pixels."""
    contents: Mapping[str, bytes] = field(default_factory=dict)

    def uri(self, ending: str) -> str:
        """Return a file as a data URI."""
        return data_uri(ending, self.contents[ending])


def html_of(page: Page) -> str:
    """Return a page as HTML: self-contained, without scripts.

    Raises
    ------
    MissingExtraError
        When matplotlib or jinja2 is not installed.
    """
    return _render(page, _drawn(page))


def write_page(page: Page, path: str | Path) -> list[Path]:
    """Write a page and a folder beside it with each figure that has data: PNG, SVG and numbers as CSV.

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
    drawn = _drawn(page)
    write_atomically(path, _render(page, drawn))
    contents = {
        f"{figure.name}.{ending}": content
        for of_section in drawn.values()
        for figure in of_section
        if "csv" in figure.contents
        for ending, content in figure.contents.items()
    }
    folder = derived(path, "-figures")
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: {error.strerror}; choose another folder") from None
    for name, content in contents.items():
        write_atomically(folder / name, content)
    return [path, *(folder / name for name in contents)]


def data_uri(ending: str, content: bytes) -> str:
    """Return a file (png, svg or csv) as a data URI."""
    return f"data:{_MEDIA_TYPES[ending]};base64,{base64.b64encode(content).decode('ascii')}"


def configuration_section(text: str, name: str = "Configuration") -> Section:
    """Return the section that shows a configuration or a specification; "" if unknown."""
    missing = "" if text.strip() else f"The {name.lower()} of this run is not known."
    identifier = "-".join(re.findall(r"\w+", name.lower()))
    return Section(identifier, name, code=text.strip(), missing=missing)


def style() -> str:
    """Return the style sheet of all pages."""
    return _template("page.css")


def _drawn(page: Page) -> dict[str, list[DrawnFigure]]:
    """Draw the figures of every section, by section name."""
    return {section.name: [_draw(figure) for figure in section.figures] for section in page.sections}


def _draw(item: FigureWithData) -> DrawnFigure:
    from faintspot.base.report import drawing

    width = round(item.figure.get_size_inches()[0] * _CSS_PIXELS_PER_INCH)
    contents = {"png": drawing.png(item.figure)}
    if item.header:
        item.figure.set_layout_engine("none")  # keep the layout, which is slow to compute
        contents |= {"svg": drawing.svg(item.figure), "csv": item.csv().encode()}
    return DrawnFigure(item.name, item.title, item.caption, width, contents)


def _render(page: Page, drawn: Mapping[str, Sequence[DrawnFigure]]) -> str:
    try:
        import jinja2
    except ImportError:
        raise MissingExtraError("jinja2", "report", "Making a report page") from None
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    template = environment.from_string(_template("page.html"))
    return template.render(page=page, drawn=drawn, style=style(), version=__version__)


def _template(name: str) -> str:
    return files("faintspot.base.report").joinpath("templates", name).read_text(encoding="utf-8")
