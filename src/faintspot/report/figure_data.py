"""A figure, what it is in words, and its numbers as a table."""

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
    """A figure for a page: with numbers (a header) it is drawn as SVG and its data may be saved, else as PNG.

    Attributes
    ----------
    name : str
        Of its files.
    title, caption : str
    figure : matplotlib Figure
    header, rows : sequence
        Its numbers; none for pictures.
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
