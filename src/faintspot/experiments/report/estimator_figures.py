"""The figures of a study that compares estimators: error, efficiency, gain and outliers, speckled spots."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from faintspot.base.report.drawing import GREY, WIDTH, new_figure, plain_ticks, styled
from faintspot.base.report.figure_data import FigureWithData
from faintspot.base.report.texts import Texts
from faintspot.experiments.methods import knows_the_spot, label_of, style_of
from faintspot.experiments.paper.figures import label_axes
from faintspot.experiments.paper.tables import parameter_in_words, parameters_of, table_of_cells
from faintspot.experiments.study.specification import BEST, CORRECTED
from faintspot.experiments.study.sweep import PARAMETERS

if TYPE_CHECKING:
    import xarray
    from matplotlib.axes import Axes


_TEXT = Texts("faintspot.experiments")
_ROW_HEIGHT = 4.4
_COLUMNS = 2
_FEWEST_POINTS = 3
_BOUND: dict[str, Any] = {"color": "black", "lw": 3, "alpha": 0.35}


@dataclass(frozen=True)
class _Panel:
    """Cells along one axis."""

    title: str
    cells: list[int]
    """By increasing value of what varies."""


@dataclass(frozen=True)
class _Group:
    """Panels of cells that have all but some parameters in common."""

    common: dict[str, Any]
    panels: list[_Panel]

    @property
    def cells(self) -> list[int]:
        return [cell for panel in self.panels for cell in panel.cells]

    @property
    def name(self) -> str:
        """A short name, different for every group."""
        standard = {"elongation": 1.0, "size": 1.0, "pixels": 16, "position_range_px": 1.0}
        standard |= {"background_e": 0.0, "em_gain": 1.0, "d_over_r0": 0.0}
        words = [
            f"{key.partition('_')[0]}{value:g}"
            for key, value in self.common.items()
            if key in standard and value != standard[key]
        ]
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
        for kind in ("error", "photon_efficiency", "gain", "outlier_fraction"):
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
        kept = [
            _Panel(
                ", ".join(parameter_in_words(name, value) for name, value in zip(by, key, strict=True)),
                sorted(cells, key=lambda cell: float(table[cell][axis])),
            )
            for key, cells in sorted(panels.items())
            if len(cells) >= _FEWEST_POINTS
        ]
        if kept:
            yield _Group(dict(zip(common, values, strict=True)), kept)


@styled
def _figure(dataset: xarray.Dataset, group: _Group, kind: str, axis: str) -> FigureWithData:
    """Draw a variable of every method along an axis, one panel for each camera, two in a row."""
    from matplotlib.lines import Line2D

    own_mode = kind == "corrected_rms" and CORRECTED in dataset["mode"].values
    mode = CORRECTED if own_mode else BEST
    columns = min(_COLUMNS, len(group.panels))
    rows = -(-len(group.panels) // columns)
    figure = new_figure(WIDTH, _ROW_HEIGHT * rows + 0.9)
    panels = figure.subplots(rows, columns, squeeze=False).ravel().tolist()
    for index, (panel, part) in enumerate(zip(panels, group.panels, strict=False)):
        shown = dataset.isel(cell=part.cells).sel(estimator=_drawn_methods(dataset), mode=mode)
        x = shown[axis].values
        for method in shown["estimator"].values:
            chosen = shown.sel(estimator=method)
            se = chosen[f"{kind}_se"].values if f"{kind}_se" in shown else None
            panel.errorbar(x, chosen[kind].values, se, elinewidth=1, zorder=3, **_line_of(str(method)))
        label_axes(panel, axis, log_y=False)
        _SCALES[kind](panel, shown, x, shown[kind].values)
        panel.set_title(part.title)
        if index % columns == 0:
            panel.set_ylabel(_TEXT[f"estimators.{kind}.axis"])
    for unused in panels[len(group.panels) :]:
        unused.set_axis_off()
    handles = [Line2D([], [], **_line_of(method)) for method in _drawn_methods(dataset)]
    if kind in ("error", "photon_efficiency"):
        handles.append(Line2D([], [], label="Cramer-Rao bound", **_BOUND))
    figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False)
    title = f"{_TEXT[f'estimators.{kind}.title']}: {group.words}"
    figure.suptitle(title, fontsize=14)
    name, caption = f"{kind.replace('_', '-')}-{group.name}", _TEXT[f"estimators.{kind}.caption"]
    return FigureWithData(name, title, caption, figure, *table_of_cells(dataset, group.cells))


def _error_scale(panel: Axes, dataset: xarray.Dataset, x: Any, values: Any) -> None:
    panel.plot(x, dataset["bound"].values, zorder=1, **_BOUND)
    panel.axhline(float(dataset["position_range_px"][0]) / 2, color=GREY, lw=1, ls=":")
    panel.set_yscale("log")
    plain_ticks(panel.yaxis, (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2))


def _efficiency_scale(panel: Axes, dataset: xarray.Dataset, x: Any, values: Any) -> None:
    panel.axhline(1.0, zorder=1, **_BOUND)
    panel.set_ylim(0, 1.35)


def _gain_scale(panel: Axes, dataset: xarray.Dataset, x: Any, values: Any) -> None:
    panel.axhline(1.0, zorder=1, **_BOUND)


def _outlier_scale(panel: Axes, dataset: xarray.Dataset, x: Any, values: Any) -> None:
    panel.set_yscale("symlog", linthresh=1e-3)
    plain_ticks(panel.yaxis, (0, 1e-3, 1e-2, 0.1, 0.5))
    panel.set_ylim(-1e-4, max(2e-3, min(1.0, 1.5 * float(np.nanmax(values)))))


def _rms_scale(panel: Axes, dataset: xarray.Dataset, x: Any, values: Any) -> None:
    best = dataset["corrected_rms"].min("estimator").values
    panel.plot(x, best, "o", ms=15, mfc="none", mec="black", mew=1.4, zorder=4)
    panel.set(xscale="log", yscale="log")
    plain_ticks(panel.xaxis, (0.3, 0.5, 1, 2, 3, 5, 10))
    plain_ticks(panel.yaxis, (0.02, 0.03, 0.05, 0.07, 0.1, 0.15, 0.2, 0.3, 0.5, 0.7, 1, 2))
    panel.set_ylim(0.85 * best.min(), min(4.0, 1.2 * float(np.nanmax(values))))


_SCALES = {
    "error": _error_scale,
    "photon_efficiency": _efficiency_scale,
    "gain": _gain_scale,
    "outlier_fraction": _outlier_scale,
    "corrected_rms": _rms_scale,
}


def _drawn_methods(dataset: xarray.Dataset) -> list[str]:
    return [str(method) for method in dataset["estimator"].values]


def _line_of(method: str) -> dict[str, Any]:
    """Return the style of a method: solid if it knows the spot, else dashed."""
    style = style_of(method)
    line = {"label": label_of(method), "color": style.colour, "marker": style.marker, "lw": 1.8}
    return {**line, "ms": 8 if style.marker == "*" else 5.5, "ls": "-" if knows_the_spot(method) else "--"}
