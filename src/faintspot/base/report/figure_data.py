"""A figure with its description, and its numbers as a table."""

from __future__ import annotations

import base64
import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_CSS_PIXELS_PER_INCH = 100
_MEDIA_TYPES = {"png": "image/png", "svg": "image/svg+xml", "csv": "text/csv;charset=utf-8"}


@dataclass(frozen=True)
class FigureWithData:
    """A figure for a page: drawn as SVG with data to save if it has a header of numbers, else as PNG.

    Attributes
    ----------
    name : str
        Base name of its files.
    title, caption : str
    figure : matplotlib Figure
    header, rows : sequence
        Its numbers; none for images.
    """

    name: str
    title: str
    caption: str
    figure: Figure
    header: Sequence[str] = ()
    rows: Sequence[Sequence[Any]] = ()

    def csv(self) -> str:
        """Return the numbers as CSV text."""
        return csv_text(self.header, self.rows)

    @property
    def width(self) -> int:
        """Width in CSS pixels."""
        return round(float(self.figure.get_size_inches()[0]) * _CSS_PIXELS_PER_INCH)

    @cached_property
    def files(self) -> dict[str, bytes]:
        """Contents of its files by ending, png alone or png, svg and csv."""
        from faintspot.base.report import plots

        contents = {"png": plots.png(self.figure)}
        if self.header:
            self.figure.set_layout_engine("none")  # keep the layout, which is slow to compute
            contents |= {"svg": plots.svg(self.figure), "csv": self.csv().encode()}
        return contents


def csv_text(header: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """Return a table as CSV text."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return stream.getvalue()


def data_uri(ending: str, content: bytes | str) -> str:
    """Return a file (png, svg or csv) as a data URI."""
    octets = content.encode() if isinstance(content, str) else content
    return f"data:{_MEDIA_TYPES[ending]};base64,{base64.b64encode(octets).decode('ascii')}"
