"""A figure with its description, and its numbers as a table."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure


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


def csv_text(header: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """Return a table as CSV text."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return stream.getvalue()
