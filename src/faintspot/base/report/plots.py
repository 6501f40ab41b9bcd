"""Plots of lines with error bars: error or Strehl ratio against flux or magnitude, spectra, time series."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from faintspot.base.report.drawing import (
    FLUX_GREY,
    GREY,
    WIDTH,
    axis_above,
    new_figure,
    plain_ticks,
    styled,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LEVEL: Mapping[str, Any] = {"color": GREY, "lw": 1}
"""Style of a horizontal line that is no measurement."""


@dataclass(frozen=True)
class Line:
    """Points joined by a line.

    Attributes
    ----------
    label : str
        "" is not in the legend.
    x, y : (n,) arrays
        Points that are not finite are left out.
    error : (n,) or (2, n) array, optional
        Length of the error bars down and up; NaN draws none.
    style : mapping
        Options of Matplotlib's `errorbar`.
    band : bool
        Whether the errors are a band instead of bars.
    x_error : (n,) array, optional
    """

    label: str
    x: ArrayLike
    y: ArrayLike
    error: ArrayLike | None = None
    style: Mapping[str, Any] = field(default_factory=dict)
    band: bool = False
    x_error: ArrayLike | None = None

    def draw(self, axes: Axes) -> None:
        """Draw it."""
        x, y = np.asarray(self.x, np.float64), np.asarray(self.y, np.float64)
        known = np.isfinite(x) & np.isfinite(y)
        x, y = x[known], y[known]
        error, x_error = (
            None if values is None else np.nan_to_num(np.asarray(values))[..., known]
            for values in (self.error, self.x_error)
        )
        if error is not None and self.band:
            down, up = np.broadcast_to(error, (2, len(y)))
            axes.fill_between(x, y - down, y + up, color=self.style["color"], alpha=0.2, lw=0)
            error = None
        axes.errorbar(x, y, error, x_error, label=self.label or None, **self.style)


@dataclass(frozen=True)
class Panel:
    """Lines in one pair of axes.

    Attributes
    ----------
    lines : sequence of Line
    x, y, title : str
        Labels with units.
    x_ticks, y_ticks : sequence of float
        Make an axis logarithmic, with these ticks.
    x_range, y_range : pair of float or None
        Limits; None is found from the lines.
    levels, at : mapping
        Styles of horizontal lines by their height, and of vertical lines by their place.
    above : array, array and str, optional
        Places, numbers there, and label of a second axis on top.
    log, grid, legend : bool
        `log` makes both axes logarithmic.
    """

    lines: Sequence[Line]
    x: str
    y: str = ""
    title: str = ""
    x_ticks: Sequence[float] = ()
    y_ticks: Sequence[float] = ()
    x_range: tuple[float | None, float | None] = (None, None)
    y_range: tuple[float | None, float | None] = (None, None)
    levels: Mapping[float, Mapping[str, object]] = field(default_factory=dict)
    at: Mapping[float, Mapping[str, Any]] = field(default_factory=dict)
    above: tuple[ArrayLike, Sequence[float], str] | None = None
    log: bool = False
    grid: bool = False
    legend: bool = False

    def draw(self, axes: Axes) -> None:
        """Draw it."""
        for line in self.lines:
            line.draw(axes)
        for height, style in self.levels.items():
            axes.axhline(height, **{**LEVEL, **style})
        for place, style in self.at.items():
            axes.axvline(place, **{**LEVEL, **style})
        if self.log:
            axes.set(xscale="log", yscale="log")
        if self.x_ticks:
            axes.set_xscale("log")
            plain_ticks(axes.xaxis, self.x_ticks)
        if self.y_ticks:
            axes.set_yscale("log")
            plain_ticks(axes.yaxis, self.y_ticks)
        ranges = {"xlim": self.x_range, "ylim": self.y_range}
        fixed = {name: limits for name, limits in ranges.items() if limits != (None, None)}
        axes.set(xlabel=self.x, ylabel=self.y, title=self.title, **fixed)
        if self.above is not None:
            axis_above(axes, *self.above).tick_params(labelsize=10)
        if self.grid:
            axes.grid(which="major", color=FLUX_GREY, lw=0.7)
        if self.legend:
            axes.legend(frameon=False, fontsize=10, handlelength=1.4)


@styled
def plot(
    panels: Sequence[Sequence[Panel]],
    height: float,
    *,
    width: float = WIDTH,
    title: str = "",
    columns: int = 4,
    legend: str = "outside lower center",
    handles: Sequence[Line] = (),
    **shared: Any,
) -> Figure:
    """Draw rows of panels.

    Parameters
    ----------
    panels : rows of Panel
    height, width : float
        Size of the figure [inch].
    title : str
    columns : int
        Columns of the legend.
    legend : str
        Where the legend is; "" draws none.
    handles : sequence of Line
        Further entries of the legend, before the labels of panels without a legend of their own, each once.
    shared : sharex, sharey
        As of Matplotlib's `subplots`.
    """
    figure = new_figure(width, height)
    grid = figure.subplots(len(panels), max(map(len, panels)), squeeze=False, **shared)
    for row, of_row in zip(grid, panels, strict=True):
        for axes, panel in zip(row, of_row, strict=False):
            panel.draw(axes)
            axes.tick_params(labelbottom=True)
            if panel is not of_row[0] and panel.y == of_row[0].y:
                axes.set_ylabel("")
        for axes in row[len(of_row) :]:
            axes.set_axis_off()
    if title:
        figure.suptitle(title, fontsize=14)
    if legend:
        _add_legend(figure, handles, legend, columns)
    return figure


def _add_legend(figure: Figure, handles: Sequence[Line], place: str, columns: int) -> None:
    from matplotlib.lines import Line2D

    entries: dict[str, Any] = {line.label: Line2D([], [], **line.style) for line in handles}
    for axes in figure.axes:
        if axes.get_legend() is None:
            found = list(zip(*axes.get_legend_handles_labels(), strict=True))
            for handle, label in sorted(found, key=lambda entry: not isinstance(entry[0], tuple)):
                entries.setdefault(label, handle)  # levels last
    if entries:
        options: dict[str, Any] = {"loc": place, "ncols": min(columns, len(entries)), "frameon": False}
        figure.legend(list(entries.values()), list(entries), **options)
