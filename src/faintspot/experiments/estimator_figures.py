"""The figures of a study that compares estimators: error, efficiency, gain and outliers, speckled spots."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from faintspot.experiments.arms import is_estimator, knows_the_spot, label_of, style_of
from faintspot.experiments.specification import BEST, CORRECTED
from faintspot.experiments.study_tables import parameter_in_words, parameters_of, table_of_cells
from faintspot.experiments.sweep import PARAMETERS
from faintspot.report.drawing import GREY, WIDTH, new_figure, plain_ticks, styled
from faintspot.report.figure_data import FigureWithData
from faintspot.report.texts import Texts

if TYPE_CHECKING:
    import xarray
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


_TEXT = Texts("faintspot.experiments")
_ROW_HEIGHT = 4.4
_COLUMNS = 2
_FEWEST_POINTS = 3


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
        yield _error_figure(dataset, group)
        yield _efficiency_figure(dataset, group)
        yield _gain_figure(dataset, group)
    for group in _groups(dataset, "d_over_r0", ("read_noise_e", "flux_e"), speckled=True):
        yield _turbulence_figure(dataset, group)


def _groups(dataset: xarray.Dataset, axis: str, by: Sequence[str], *, speckled: bool) -> Iterator[_Group]:
    """Yield the groups of cells that differ in `axis`, within a panel, and in `by`, between panels."""
    done = [int(cell) for cell in np.flatnonzero(dataset["done"].values)]
    table = dict(zip(done, parameters_of(dataset, done), strict=True))
    found: dict[tuple[Any, ...], dict[tuple[Any, ...], list[int]]] = {}
    common = [name for name in PARAMETERS if name not in (axis, *by)]
    for cell, row in table.items():
        if (row["d_over_r0"] > 0) == speckled:
            panels = found.setdefault(tuple(row[name] for name in common), {})
            panels.setdefault(tuple(row[name] for name in by), []).append(cell)
    for values, panels in sorted(found.items()):
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
def _error_figure(dataset: xarray.Dataset, group: _Group) -> FigureWithData:
    figure, axes = _grid(group)
    for panel, part in zip(axes, group.panels, strict=False):
        _lines(panel, dataset, part, "error", BEST, "flux_e")
        flux = dataset["flux_e"].values[part.cells]
        panel.plot(flux, dataset["bound"].values[part.cells], color="black", lw=3, alpha=0.35, zorder=1)
        panel.axhline(group.common["position_range_px"] / 2, color=GREY, lw=1, ls=":")
        panel.set_yscale("log")
        plain_ticks(panel.yaxis, (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2))
    _label(axes, group, "slope error R (px)")
    _legend(figure, dataset, bound=True)
    return _with_data(figure, dataset, group, "error")


@styled
def _efficiency_figure(dataset: xarray.Dataset, group: _Group) -> FigureWithData:
    figure, axes = _grid(group)
    for panel, part in zip(axes, group.panels, strict=False):
        _lines(panel, dataset, part, "photon_efficiency", BEST, "flux_e")
        panel.axhline(1.0, color="black", lw=3, alpha=0.35, zorder=1)
        panel.set_ylim(0, 1.35)
    _label(axes, group, "photon efficiency")
    _legend(figure, dataset, bound=True)
    return _with_data(figure, dataset, group, "efficiency")


@styled
def _gain_figure(dataset: xarray.Dataset, group: _Group) -> FigureWithData:
    columns = len(group.panels)
    figure = new_figure(WIDTH * max(1.0, columns / 3), 2 * _ROW_HEIGHT + 0.9)
    axes = figure.subplots(2, columns, squeeze=False, sharex="col", sharey="row")
    for (upper, lower), part in zip(axes.T, group.panels, strict=True):
        _lines(upper, dataset, part, "gain", BEST, "flux_e")
        upper.axhline(1.0, color="black", lw=3, alpha=0.35, zorder=1)
        upper.set_title(part.title)
        _lines(lower, dataset, part, "outlier_fraction", BEST, "flux_e")
        lower.set_yscale("symlog", linthresh=1e-3)
        plain_ticks(lower.yaxis, (0, 1e-3, 1e-2, 0.1, 0.5))
        _flux_axis(lower)
    drawn = dataset["outlier_fraction"].sel(mode=BEST).isel(cell=group.cells).values
    axes[1, 0].set_ylim(-1e-4, max(2e-3, min(1.0, 1.5 * float(np.nanmax(drawn)))))
    axes[0, 0].set_ylabel("gain")
    axes[1, 0].set_ylabel("fraction of errors beyond 1 px")
    _legend(figure, dataset, bound=False)
    return _with_data(figure, dataset, group, "gain")


@styled
def _turbulence_figure(dataset: xarray.Dataset, group: _Group) -> FigureWithData:
    mode = CORRECTED if CORRECTED in dataset["mode"].values else BEST
    figure, axes = _grid(group)
    for panel, part in zip(axes, group.panels, strict=False):
        _lines(panel, dataset, part, "corrected_rms", mode, "d_over_r0")
        values = dataset["corrected_rms"].sel(mode=mode).isel(cell=part.cells)
        drawn = values.sel(arm=_drawn_arms(dataset))
        best = drawn.min("arm").values
        x = dataset["d_over_r0"].values[part.cells]
        panel.plot(x, best, "o", ms=15, mfc="none", mec="black", mew=1.4, zorder=4)
        panel.set_yscale("log")
        panel.set_xscale("log")
        plain_ticks(panel.xaxis, (0.3, 0.5, 1, 2, 3, 5, 10))
        plain_ticks(panel.yaxis, (0.02, 0.03, 0.05, 0.07, 0.1, 0.15, 0.2, 0.3, 0.5, 0.7, 1, 2))
        panel.set_ylim(0.85 * best.min(), min(4.0, 1.2 * float(np.nanmax(drawn.values))))
    _label(axes, group, "gain-corrected rms (px)", flux=False)
    _legend(figure, dataset, bound=False)
    return _with_data(figure, dataset, group, "turbulence")


def _with_data(figure: Figure, dataset: xarray.Dataset, group: _Group, kind: str) -> FigureWithData:
    """Return a figure with its title and the numbers of the group's cells."""
    subject, caption = (_TEXT[f"estimators.{kind}.{part}"] for part in ("title", "caption"))
    title = f"{subject}: {group.words}"
    figure.suptitle(title, fontsize=14)
    return FigureWithData(
        f"{kind}-{group.name}", title, caption, figure, *table_of_cells(dataset, group.cells)
    )


def _grid(group: _Group) -> tuple[Figure, list[Axes]]:
    """Return a figure and axes, one for each panel, two in a row."""
    columns = min(_COLUMNS, len(group.panels))
    rows = -(-len(group.panels) // columns)
    figure = new_figure(WIDTH, _ROW_HEIGHT * rows + 0.9)
    axes = figure.subplots(rows, columns, squeeze=False).ravel().tolist()
    for unused in axes[len(group.panels) :]:
        unused.set_axis_off()
    return figure, axes[: len(group.panels)]


def _lines(panel: Axes, dataset: xarray.Dataset, part: _Panel, name: str, mode: str, axis: str) -> None:
    """Draw a variable of every arm."""
    x = dataset[axis].values[part.cells]
    for arm in _drawn_arms(dataset):
        chosen = dataset.sel(arm=arm, mode=mode).isel(cell=part.cells)
        se_name = f"{name}_se"
        se = chosen[se_name].values if se_name in dataset else None
        panel.errorbar(x, chosen[name].values, se, elinewidth=1, zorder=3, **_line_of(arm))


def _drawn_arms(dataset: xarray.Dataset) -> list[str]:
    return [str(arm) for arm in dataset["arm"].values if is_estimator(str(arm))]


def _line_of(arm: str) -> dict[str, Any]:
    """Return the style of a method: solid if it knows the spot, else dashed."""
    style = style_of(arm)
    return {
        "label": label_of(arm),
        "color": style.colour,
        "marker": style.marker,
        "ms": 8 if style.marker == "*" else 5.5,
        "lw": 1.8,
        "ls": "-" if knows_the_spot(arm) else "--",
    }


def _label(axes: list[Axes], group: _Group, y: str, *, flux: bool = True) -> None:
    for index, (panel, part) in enumerate(zip(axes, group.panels, strict=True)):
        panel.set_title(part.title)
        panel.set_xlabel("side of the sub-aperture over r0")
        if index % _COLUMNS == 0:
            panel.set_ylabel(y)
        if flux:
            _flux_axis(panel)


def _flux_axis(panel: Axes) -> None:
    panel.set_xscale("log")
    plain_ticks(panel.xaxis, (10, 30, 100, 300, 1000, 3000, 10000))
    panel.set_xlabel("signal (photo-electrons per spot)")


def _legend(figure: Figure, dataset: xarray.Dataset, *, bound: bool) -> None:
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], **_line_of(arm)) for arm in _drawn_arms(dataset)]
    if bound:
        handles.append(Line2D([], [], color="black", lw=3, alpha=0.35, label="Cramer-Rao bound"))
    figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False)
