"""The texts of report pages: TOML files named `texts.toml`, in the packages whose modules fill them in."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from functools import cached_property, reduce
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from faintspot.base.report.figure_data import FigureWithData
from faintspot.base.report.page import Cell, Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Texts:
    """Texts of a package by dotted names, with values put in where they have {names}.

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

    def __call__(self, name: str, /, **values: object) -> str:
        """Return a text with values filled in."""
        return str(self[name].format(**values))

    def figure(
        self,
        name: str,
        figure: Figure,
        rows: Sequence[Sequence[Any]] = (),
        columns: Sequence[str] = (),
        /,
        **values: object,
    ) -> FigureWithData:
        """Return a figure with its title and caption, and the columns of its numbers."""
        title, caption = (self(f"{name}.{part}", **values) for part in ("title", "caption"))
        return FigureWithData(name, title, caption, figure, columns or self[name].get("columns", ()), rows)

    def table(
        self,
        name: str,
        rows: Sequence[Sequence[str | Cell]],
        columns: Sequence[str] = (),
        /,
        **values: object,
    ) -> Table:
        """Return a table with its caption and the header: fixed columns, then those given."""
        caption = self(f"{name}.caption", **values)
        return Table([*self[name].get("columns", ()), *columns], rows, caption)
