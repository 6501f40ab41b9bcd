"""Figures of reports: their common style, and lines with error bars."""

from __future__ import annotations

import functools
import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import not_none
from faintspot.base.errors import MissingExtraError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


try:
    import matplotlib
    from matplotlib.axes import Axes
    from matplotlib.axis import XAxis, YAxis
    from matplotlib.figure import Figure
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator
except ImportError:
    raise MissingExtraError("matplotlib", "report", "Drawing pictures") from None

COLOUR_MAP = "cividis"
# Okabe & Ito (2008): readable with any colour vision.
METHOD_COLOURS = ("#D55E00", "#0072B2", "#009E73", "#CC79A7")
TRUTH_COLOUR = "#56B4E9"
GREY = "#9a9a9a"
FLUX_GREY = "#e4e4e4"
DOTS_PER_INCH = 144
WIDTH = 13.0
"""Width of a full-width figure [inch]."""

_STYLE: dict[str, Any] = {
    "font.size": 12,
    "axes.titlesize": 13,
    "axes.labelsize": 12,
    "legend.fontsize": 11,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "image.cmap": COLOUR_MAP,
    "image.origin": "lower",
}

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")


def styled(draw: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Make a drawing function use the report's style, independent of the user's settings."""

    @functools.wraps(draw)
    def with_style(*arguments: _Arguments.args, **options: _Arguments.kwargs) -> _Result:
        with matplotlib.rc_context():
            matplotlib.rcdefaults()
            matplotlib.rcParams.update(_STYLE)  # type: ignore[arg-type]
            return draw(*arguments, **options)

    return with_style


def new_figure(width: float, height: float) -> Figure:
    """Return an empty white figure; width and height in inches."""
    return Figure(figsize=(width, height), layout="constrained", facecolor="white")


@styled  # ticks are created here
def png(figure: Figure, *, tight: bool = True) -> bytes:
    """Return a figure as PNG; `tight` trims the margins, which requires drawing twice."""
    stream = io.BytesIO()
    cut: dict[str, Any] = {"bbox_inches": "tight", "pad_inches": 0.15} if tight else {}
    figure.savefig(stream, format="png", dpi=DOTS_PER_INCH, **cut)
    return stream.getvalue()


@styled
def svg(figure: Figure) -> bytes:
    """Return a figure as SVG; equal figures give equal bytes."""
    matplotlib.rcParams["svg.hashsalt"] = "faintspot"
    stream = io.BytesIO()
    figure.savefig(stream, format="svg", metadata={"Date": None})
    return stream.getvalue()


def plain_ticks(axis: XAxis | YAxis, values: Iterable[float]) -> None:
    """Set ticks at these values only, with three digits and no exponent."""
    axis.set_major_locator(FixedLocator([float(value) for value in values]))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{float(f'{value:.3g}'):g}"))


_LONG_LABEL = 6  # letters, from which every other one is left out


def axis_above(axes: Axes, positions: Any, values: Iterable[float], label: str) -> Any:
    """Put a second axis on top: numbers to three digits at places of the first one."""
    top = axes.secondary_xaxis("top")
    labels = [f"{float(f'{value:.3g}'):g}" for value in values]
    if max(map(len, labels), default=0) > _LONG_LABEL:
        labels[1::2] = [""] * len(labels[1::2])
    top.set_xticks(positions, labels)
    top.set_xlabel(label)
    return top


def note(axes: Axes, text: str, position: tuple[float, float], coordinates: str, **style: Any) -> None:
    """Write a text beside a place, some points away; coordinates "data", "axes fraction" or one for each."""
    x, _, y = coordinates.partition(", ")
    axes.annotate(text, position, xycoords=(x, y or x), textcoords="offset points", **style)


def colour_bar(axes: Axes | list[Axes], mappable: Any, label: str, location: str = "right") -> None:
    """Add a colour bar to one or several axes."""
    first = axes[0] if isinstance(axes, list) else axes
    figure = not_none(first.get_figure())
    bar = figure.colorbar(mappable, ax=axes, label=label, location=location, shrink=0.85, pad=0.02, aspect=25)
    bar.outline.set_visible(False)


def limits_of(*arrays: NDArray[Any], low: float | None = None, percent: float = 100.0) -> tuple[float, float]:
    """Return common colour limits for several maps; never an empty range."""
    values = np.concatenate([array[np.isfinite(array)] for array in map(np.ravel, arrays)])
    if values.size == 0:
        return 0.0, 1.0
    start = float(np.percentile(values, 100.0 - percent)) if low is None else low
    stop = float(np.percentile(values, percent))
    return (start, stop) if stop > start else (start, start + max(1e-3, abs(start)))


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
