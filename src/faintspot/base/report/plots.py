"""Figures of reports as rows of what is drawn in a pair of axes: lines with error bars, pictures."""

from __future__ import annotations

import functools
import io
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from typing import Any, ParamSpec, Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import not_none
from faintspot.base.errors import InputError, MissingExtraError
from faintspot.base.files import csv_text

try:
    import matplotlib
    from matplotlib.axes import Axes
    from matplotlib.axis import XAxis, YAxis
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
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


def _axis_above(axes: Axes, positions: ArrayLike, values: Iterable[float], label: str) -> None:
    """Put a second axis on top: numbers to three digits at places of the first one."""
    top = axes.secondary_xaxis("top")
    labels = [f"{float(f'{value:.3g}'):g}" for value in values]
    if max(map(len, labels), default=0) > 6:
        labels[1::2] = [""] * len(labels[1::2])
    top.set_xticks(positions, labels)
    top.set_xlabel(label)
    top.tick_params(labelsize=10)


def colour_bar(axes: Axes, mappable: Any, label: str) -> None:
    """Add a colour bar."""
    figure = not_none(axes.get_figure())
    bar = figure.colorbar(mappable, ax=axes, label=label, shrink=0.85, pad=0.02, aspect=25)
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


class Mark(Protocol):
    """Something that is drawn on axes."""

    def draw(self, axes: Axes) -> None:
        """Draw it."""


class Drawing(Mark, Protocol):
    """Content of a pair of axes."""

    @property
    def y(self) -> str:
        """Label of the vertical axis."""

    @property
    def share(self) -> float:
        """Width relative to that of others."""


@dataclass(frozen=True)
class Line:
    """Points joined by a line.

    Attributes
    ----------
    label : str
        Name in the legend and in the table of the numbers.
    x, y : (n,) arrays
        Points that are not finite are left out.
    error : (n,) or (2, n) array, optional
        Length of the error bars down and up; NaN draws none.
    style : mapping
        Options of Matplotlib's `errorbar`.
    band : bool
        Whether the errors are a band instead of bars.
    x_error : (n,) array, optional
    in_legend : bool
    """

    label: str
    x: ArrayLike
    y: ArrayLike
    error: ArrayLike | None = None
    style: Mapping[str, Any] = field(default_factory=dict)
    band: bool = False
    x_error: ArrayLike | None = None
    in_legend: bool = True

    @classmethod
    def of(cls, label: str, points: NDArray[Any], style: Mapping[str, Any]) -> Line:
        """Return a line through points, (n, 2)."""
        return cls(label, points[:, 0], points[:, 1], style=style)

    def points(self) -> NDArray[np.float64]:
        """Return x, y and the lengths of the errors down, up and along x of its points, (n, 5)."""
        x, y = np.asarray(self.x, np.float64), np.asarray(self.y, np.float64)
        error, x_error = (np.nan if values is None else values for values in (self.error, self.x_error))
        columns = x, y, *np.broadcast_to(error, (2, len(x))), np.broadcast_to(x_error, len(x))
        return np.stack([*columns], axis=1, dtype=np.float64)[np.isfinite(x) & np.isfinite(y)]

    def draw(self, axes: Axes) -> None:
        """Draw it."""
        x, y, *errors = self.points().T
        down, up, x_error = map(np.nan_to_num, errors)
        if self.band:
            axes.fill_between(x, y - down, y + up, color=self.style["color"], alpha=0.2, lw=0)
        error = None if self.error is None or self.band else (down, up)
        label = self.label if self.label and self.in_legend else None
        axes.errorbar(x, y, error, None if self.x_error is None else x_error, label=label, **self.style)


@dataclass(frozen=True)
class Labels:
    """Words at points, (n, 2); `style` has options of Matplotlib's `text`."""

    at: ArrayLike
    words: Sequence[str]
    style: Mapping[str, Any]

    def draw(self, axes: Axes) -> None:
        """Write them."""
        for (x, y), word in zip(np.asarray(self.at), self.words, strict=True):
            axes.text(x, y, word, **{"in_layout": False, "clip_on": True, **self.style})


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
    log : str
        Axes that are logarithmic: "", "x", "y" or "xy".
    names : mapping
        Names of places on the horizontal axis, in place of numbers.
    grid, legend : bool
    share : float
        Width relative to that of others.
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
    log: str = ""
    names: Mapping[float, str] = field(default_factory=dict)
    grid: bool = False
    legend: bool = False
    share: float = 1.0

    def draw(self, axes: Axes) -> None:
        """Draw it."""
        for line in self.lines:
            line.draw(axes)
        for height, style in self.levels.items():
            axes.axhline(height, **{**LEVEL, **style})
        for place, style in self.at.items():
            axes.axvline(place, **{**LEVEL, **style})
        logarithmic = self.log + "x" * bool(self.x_ticks) + "y" * bool(self.y_ticks)
        axes.set(**{f"{axis}scale": "log" for axis in logarithmic})
        for axis, ticks in ((axes.xaxis, self.x_ticks), (axes.yaxis, self.y_ticks)):
            if ticks:
                plain_ticks(axis, ticks)
        if self.names:
            axes.set_xticks(list(self.names), list(self.names.values()), rotation=90, fontsize=9)
        ranges = {"xlim": self.x_range, "ylim": self.y_range}
        fixed = {name: limits for name, limits in ranges.items() if limits != (None, None)}
        axes.set(xlabel=self.x, ylabel=self.y, title=self.title, **fixed)
        if self.above is not None:
            _axis_above(axes, *self.above)
        if self.grid:
            axes.grid(which="major", color=FLUX_GREY, lw=0.7)
        if self.legend:
            axes.legend(frameon=False, fontsize=10, handlelength=1.4)

    def numbers(self) -> Iterator[tuple[object, ...]]:
        """Yield a row for each point, as of `csv_of`."""
        for line in self.lines:
            for point in line.points().tolist():
                cells = ("" if np.isnan(number) else f"{number:.7g}" for number in point)
                yield self.title.replace("\n", ", "), self.x, self.y, line.label, *cells


@dataclass(frozen=True)
class Picture:
    """An image, with marks on it.

    Attributes
    ----------
    image : (h, w) array
    unit : str
        Label of the colour bar; "" draws none.
    title, x, y : str
    style : mapping
        Options of Matplotlib's `imshow`.
    marks : sequence of Mark
    x_range, y_range : pair of float, optional
    x_names, y_names : sequence of str
        Names of columns and rows, in place of numbers.
    background : str
        Colour where the image has no value.
    share : float
        Width relative to that of others.
    """

    image: NDArray[Any]
    unit: str = ""
    title: str = ""
    x: str = "column (px)"
    y: str = "row (px)"
    style: Mapping[str, Any] = field(default_factory=dict)
    marks: Sequence[Mark] = ()
    x_range: tuple[float, float] | None = None
    y_range: tuple[float, float] | None = None
    x_names: Sequence[str] = ()
    y_names: Sequence[str] = ()
    background: str = FLUX_GREY
    share: float = 1.0

    def draw(self, axes: Axes) -> None:
        """Draw it."""
        image = axes.imshow(self.image, **{"interpolation": "nearest", **self.style})
        for mark in self.marks:
            mark.draw(axes)
        axes.set(xlabel=self.x, ylabel=self.y, title=self.title, facecolor=self.background)
        axes.set(xlim=self.x_range or image.get_extent()[:2], ylim=self.y_range or image.get_extent()[2:])
        for axis, names in ((axes.xaxis, self.x_names), (axes.yaxis, self.y_names)):
            if names:
                axis.set_ticks(range(len(names)), names)
        if self.unit:
            colour_bar(axes, image, self.unit)


def draw(rows: Sequence[Sequence[Drawing]], axes: Any = None) -> Any:
    """Draw on a user's axes, in the user's style, or on new ones that pyplot shows.

    Parameters
    ----------
    rows : rows of Drawing
    axes : Axes or array of Axes, optional
        One for each drawing, in their order.

    Returns
    -------
    Axes or (n,) array of Axes

    Raises
    ------
    InputError
        If there is another number of axes.
    """
    drawings = list(chain(*rows))
    if axes is None:
        from matplotlib import pyplot  # which chooses how figures are shown

        columns = max(map(len, rows))
        size = 5.6 * columns + 0.8, 5.2 * len(rows)
        _, grid = pyplot.subplots(len(rows), columns, squeeze=False, figsize=size, layout="constrained")
        axes = [place for row, places in zip(rows, grid, strict=True) for place in places[: len(row)]]
    places = np.asarray(axes, object).ravel()
    if len(places) != len(drawings):
        raise InputError(f"axes: expected {len(drawings)}, one for each drawing, got {len(places)}")
    with matplotlib.rc_context({"image.origin": "lower", "image.cmap": COLOUR_MAP}):
        for drawing, place in zip(drawings, places, strict=True):
            drawing.draw(place)
    return places if len(places) > 1 else places[0]


def csv_of(rows: Iterable[Iterable[Drawing]]) -> str:
    """Return the numbers of all lines as CSV; "" where there are no lines."""
    numbers = [row for part in chain(*rows) if isinstance(part, Panel) for row in part.numbers()]
    header = "panel", "x axis", "y axis", "line", "x", "y", "error down", "error up", "error of x"
    return csv_text(header, numbers) if numbers else ""


@styled
def plot(
    rows: Sequence[Sequence[Drawing]],
    height: float,
    *,
    width: float = WIDTH,
    heading: str = "",
    columns: int = 4,
    legend: str = "outside lower center",
    handles: Sequence[Line] = (),
    shared: bool = False,
    **legend_style: Any,
) -> Figure:
    """Draw rows of panels, pictures and maps.

    Parameters
    ----------
    rows : rows of Drawing
    height, width : float
        Size of the figure [inch].
    heading : str
        Above all.
    columns : int
        Columns of the legend.
    legend : str
        Where the legend is; "" draws none.
    handles : sequence of Line
        Further entries of the legend, before the labels of panels without a legend of their own, each once.
    shared : bool
        Whether all share the horizontal axis, and those of a row the vertical one.
    legend_style
        Options of Matplotlib's `Figure.legend`.
    """
    figure = new_figure(width, height)
    first: dict[str, Axes] = {}
    for row, places in zip(rows, _places(figure, rows), strict=True):
        first.pop("sharey", None)
        for part, place in zip(row, places, strict=True):
            axes = figure.add_subplot(place, **(first if shared else {}))
            first = {"sharex": axes, "sharey": axes, **first}
            part.draw(axes)
            if part is not row[0] and part.y == row[0].y:
                axes.set_ylabel("")
    if heading:
        figure.suptitle(heading, fontsize=14)
    if legend:
        _add_legend(figure, handles, {"loc": legend, "frameon": False, **legend_style}, columns)
    return figure


def _places(figure: Figure, rows: Sequence[Sequence[Drawing]]) -> list[list[Any]]:
    """Return a place for each drawing, in columns where all have the same share."""
    if all(part.share == 1 for part in chain(*rows)):
        grid = figure.add_gridspec(len(rows), max(map(len, rows)))
        return [[grid[number, column] for column in range(len(row))] for number, row in enumerate(rows)]
    whole = figure.add_gridspec(len(rows), 1)
    shares = [[part.share for part in row] for row in rows]
    grids = [whole[n].subgridspec(1, len(row), width_ratios=row) for n, row in enumerate(shares)]
    return [[grid[0, column] for column in range(len(row))] for grid, row in zip(grids, rows, strict=True)]


def _add_legend(figure: Figure, handles: Sequence[Line], style: dict[str, Any], columns: int) -> None:
    entries: dict[str, Any] = {line.label: Line2D([], [], **line.style) for line in handles}
    for axes in figure.axes:
        if axes.get_legend() is None:
            found = list(zip(*axes.get_legend_handles_labels(), strict=True))
            for handle, label in sorted(found, key=lambda entry: not isinstance(entry[0], tuple)):
                entries.setdefault(label, handle)  # levels last
    if entries:
        figure.legend(list(entries.values()), list(entries), ncols=min(columns, len(entries)), **style)
