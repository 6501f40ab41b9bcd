"""The figures of a study that compares estimators: error, efficiency, gain, speckled spots."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from faintspot.base.report.figure_data import FigureWithData
from faintspot.base.report.plots import Line, Panel, plot
from faintspot.base.report.texts import Texts
from faintspot.experiments.methods import knows_the_spot, label_of, style_of
from faintspot.experiments.paper.figures import axis_of_study
from faintspot.experiments.paper.tables import parameter_in_words, parameters_of, table_of_cells
from faintspot.experiments.report.efficiency import corrected_mode
from faintspot.experiments.study.specification import BEST
from faintspot.experiments.study.sweep import PARAMETERS

if TYPE_CHECKING:
    import xarray


_TEXT = Texts("faintspot.experiments")
_ROW_HEIGHT = 4.4
_COLUMNS = 2
_FEWEST_POINTS = 3
_BOUND: dict[str, Any] = {"color": "black", "lw": 3, "alpha": 0.35, "zorder": 1}
_BEST_OF_CELL: dict[str, Any] = {"ls": "", "marker": "o", "ms": 15, "mfc": "none", "mec": "black", "mew": 1.4}
_STANDARD = {"elongation": 1.0, "size": 1.0, "pixels": 16, "position_range_px": 1.0}
_STANDARD |= {"background_e": 0.0, "em_gain": 1.0, "d_over_r0": 0.0}


@dataclass(frozen=True)
class _Group:
    """Panels of cells that have all but some parameters in common."""

    common: Mapping[str, Any]
    panels: Mapping[str, list[int]]
    """Cells by increasing value of what varies, by the title of their panel."""

    @property
    def cells(self) -> list[int]:
        return [cell for cells in self.panels.values() for cell in cells]

    @property
    def name(self) -> str:
        """A short name, different for every group."""
        changed = {key: value for key, value in self.common.items() if value != _STANDARD.get(key, value)}
        words = [f"{key.partition('_')[0]}{value:g}" for key, value in changed.items()]
        return "-".join([self.common["profile"], *words])

    @property
    def words(self) -> str:
        """Parameters that the cells share."""
        named = [parameter_in_words(key, value) for key, value in self.common.items()]
        return ", ".join(text for text in named if not text.startswith("no "))


def estimator_figures(dataset: xarray.Dataset) -> Iterator[FigureWithData]:
    """Yield the figures of a study that compares estimators, as far as its cells are finished.

    Cells that differ in flux (or, speckled ones, in d/r0) alone are a line, where there are at least three.
    """
    for group in _groups(dataset, "flux_e", ("read_noise_e",), speckled=False):
        for kind in ("error", "photon_efficiency", "gain"):
            yield _figure(dataset, group, kind, "flux_e")
    for group in _groups(dataset, "d_over_r0", ("read_noise_e", "flux_e"), speckled=True):
        yield _figure(dataset, group, "corrected_rms", "d_over_r0")


def _groups(dataset: xarray.Dataset, axis: str, by: Sequence[str], *, speckled: bool) -> Iterator[_Group]:
    """Yield the groups of cells that differ in `axis`, within a panel, and in `by`, between panels."""
    done = [int(cell) for cell in np.flatnonzero(dataset["done"].values)]
    table = dict(zip(done, parameters_of(dataset, done), strict=True))
    groups: dict[tuple[Any, ...], dict[tuple[Any, ...], list[int]]] = {}
    common = [name for name in PARAMETERS if name not in (axis, *by)]
    for cell, row in table.items():
        if (row["d_over_r0"] > 0) == speckled:
            panels = groups.setdefault(tuple(row[name] for name in common), {})
            panels.setdefault(tuple(row[name] for name in by), []).append(cell)
    for values, panels in sorted(groups.items()):
        kept = {
            ", ".join(map(parameter_in_words, by, key)): sorted(
                cells, key=lambda cell: float(table[cell][axis])
            )
            for key, cells in sorted(panels.items())
            if len(cells) >= _FEWEST_POINTS
        }
        if kept:
            yield _Group(dict(zip(common, values, strict=True)), kept)


def _figure(dataset: xarray.Dataset, group: _Group, kind: str, axis: str) -> FigureWithData:
    """Draw a variable of every method along an axis, one panel for each camera, two in a row."""
    mode = corrected_mode(dataset) if kind == "corrected_rms" else BEST
    panels = [
        _panel(dataset.isel(cell=cells).sel(mode=mode), kind, axis, title)
        for title, cells in group.panels.items()
    ]
    rows = [panels[first : first + _COLUMNS] for first in range(0, len(panels), _COLUMNS)]
    title = f"{_TEXT[f'estimators.{kind}.title']}: {group.words}"
    figure = plot(rows, _ROW_HEIGHT * len(rows) + 0.9, title=title)
    name, caption = f"{kind.replace('_', '-')}-{group.name}", _TEXT[f"estimators.{kind}.caption"]
    return FigureWithData(name, title, caption, figure, *table_of_cells(dataset, group.cells))


def _panel(cells: xarray.Dataset, kind: str, axis: str, title: str) -> Panel:
    x, values = cells[axis].values, cells[kind]
    errors = cells.get(f"{kind}_se")
    lines = []
    for method in map(str, cells["estimator"].values):
        error = None if errors is None else errors.sel(estimator=method).values
        style = {**_style_of(method), "elinewidth": 1, "zorder": 3}
        lines.append(Line(label_of(method), x, values.sel(estimator=method).values, error, style))
    scale: dict[str, Any] = {}
    if kind == "error":
        lines.append(Line("Cramer-Rao bound", x, cells["bound"].values, style=_BOUND))
        scale["levels"] = {float(cells["position_range_px"][0]) / 2: {"ls": ":"}}
        scale["y_ticks"] = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2)
    elif kind == "corrected_rms":
        best = values.min("estimator").values
        lines.append(Line("", x, best, style={**_BEST_OF_CELL, "zorder": 4}))
        scale["x_ticks"] = (0.3, 0.5, 1, 2, 3, 5, 10)
        scale["y_ticks"] = (0.02, 0.03, 0.05, 0.07, 0.1, 0.15, 0.2, 0.3, 0.5, 0.7, 1, 2)
        scale["y_range"] = (0.85 * best.min(), min(4.0, 1.2 * float(np.nanmax(values))))
    else:
        scale["levels"] = {1.0: _BOUND}
        if kind == "photon_efficiency":
            scale = {"levels": {1.0: {**_BOUND, "label": "Cramer-Rao bound"}}, "y_range": (0, 1.35)}
    return Panel(lines, y=_TEXT[f"estimators.{kind}.axis"], title=title, **{**axis_of_study(axis), **scale})


def _style_of(method: str) -> dict[str, Any]:
    """Return the style of a method: solid if it knows the spot, else dashed."""
    style = style_of(method)
    marker = {"marker": style.marker, "ms": 8 if style.marker == "*" else 5.5}
    return {"color": style.colour, "lw": 1.8, "ls": "-" if knows_the_spot(method) else "--", **marker}
