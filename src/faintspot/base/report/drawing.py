"""Common style of a report's figures: no global state, colours, axes."""

from __future__ import annotations

import functools
import io
from collections.abc import Callable, Iterable
from typing import Any, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from faintspot.base.checks import not_none
from faintspot.base.errors import MissingExtraError

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
