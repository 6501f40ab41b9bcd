"""The pictures of a page, drawn from its tables alone; None where a table or a column of it is not there."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from benchmarks.latency import UNDISTURBED
from benchmarks.measuring import Row, Table
from faintspot.report.drawing import ARM_COLOURS, GREY, new_figure, styled

Tables = dict[str, Table]
_ORANGE, _BLUE, _GREEN, _PINK = ARM_COLOURS
_MARKERS = ("o", "s", "^", "D")


@styled
def rivals(tables: Tables) -> Figure | None:
    """Draw how many times faintspot's time each rival takes."""
    colours = {"36": _BLUE, "4616": _ORANGE}
    bars = [(row, colours.get(row.name.split(":")[0], GREY), "") for row in _rows(tables, "rivals")]
    bars += [(row, GREY, "//") for row in _rows(tables, "rivals_others")]
    bars = [bar for bar in bars if "median ratio" in bar[0].values]
    if not bars:
        return None
    bars.sort(key=lambda bar: (bar[1] == GREY, bar[0].name.split(":")[0], bar[0].values["median ratio"]))
    figure = new_figure(11.0, 1.4 + 0.42 * len(bars))
    axes = figure.add_subplot()
    for place, (row, colour, hatch) in enumerate(reversed(bars)):
        ratio = row.values["median ratio"]
        axes.barh(place, ratio, 0.62, color=colour, hatch=hatch, edgecolor="white", linewidth=0)
        axes.annotate(
            f"{ratio:.3g}", (ratio, place), (6, 0), textcoords="offset points", va="center", fontsize=11
        )
        if row.target.startswith(">="):
            target = float(row.target.split()[1])
            axes.plot([target] * 2, [place - 0.42, place + 0.42], color="black", lw=2.5)
    axes.set_yticks(range(len(bars)), [_label(row.name) for row, _, _ in reversed(bars)])
    axes.set_xscale("log")
    axes.set_xlim(1.0, 2.2 * max(row.values["median ratio"] for row, _, _ in bars))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.set_xlabel("time of the other / time of faintspot, one thread")
    return figure


def _label(name: str) -> str:
    number, _, rival = name.partition(": ")
    return f"{rival} ({number})" if rival else name


@styled
def scale(tables: Tables) -> Figure | None:
    """Draw time per frame and per sub-aperture against the number of sub-apertures."""
    series: dict[tuple[str, int], list[tuple[float, float]]] = {}
    for row in _rows(tables, "scale"):
        side = row.name.partition(" of ")[2]
        for cores, column in ((1, "1 core: us per frame"), (2, "2 cores: us per frame")):
            if column in row.values and "sub-apertures" in row.values:
                point = row.values["sub-apertures"], row.values[column]
                series.setdefault((side, cores), []).append(point)
    if not series:
        return None
    figure = new_figure(13.0, 5.4)
    whole, each = figure.subplots(1, 2)
    sides = list(dict.fromkeys(side for side, _ in series))
    for (side, cores), points in series.items():
        n, time = np.array(sorted(points)).T
        index = sides.index(side) % len(ARM_COLOURS)
        style = {
            "color": ARM_COLOURS[index],
            "marker": _MARKERS[index],
            "ls": "-" if cores == 1 else "--",
            "mfc": ARM_COLOURS[index] if cores == 1 else "white",
            "label": f"{side} px, {cores} core{'s' if cores > 1 else ''}",
        }
        whole.plot(n, time, **style)
        each.plot(n, time / n, **style)
    ends = np.array([min(n), max(n)])
    whole.plot(ends, 1.5 * (time / n).max() * ends, color=GREY, lw=1.5, ls=":", label="linear")
    whole.set_ylabel("time per frame (µs)")
    each.set_ylabel("time per sub-aperture (µs)")
    for axes in (whole, each):
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xlabel("number of sub-apertures")
        axes.grid(color="#e4e4e4", lw=0.8)
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    each.yaxis.set_minor_formatter(FuncFormatter(_few))
    handles, labels = whole.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=4, frameon=False)
    return figure


def _few(value: float, _: int) -> str:
    return f"{value:g}" if f"{value:e}"[0] in "235" else ""


@styled
def latency(tables: Tables) -> Figure | None:
    """Draw the fraction of frames that take longer, against the latency."""
    curves = tables["latency"].curves if "latency" in tables else {}
    if not curves:
        return None
    figure = new_figure(11.0, 5.6)
    axes = figure.add_subplot()
    for level, name in ((0.5, "p50"), (0.01, "p99"), (0.001, "p99.9")):
        axes.axhline(level, color=GREY, lw=0.8, ls=":")
        axes.annotate(name, (1.0, level), (4, 0), ("axes fraction", "data"), "offset points", va="center")
    plain = [name for name in curves if not name.endswith(UNDISTURBED)]
    for name, points in curves.items():
        index = plain.index(name.removesuffix(f", {UNDISTURBED}"))
        x, y = np.array(points).T
        colour, style = ARM_COLOURS[index % len(ARM_COLOURS)], "-" if name in plain else "--"
        axes.step(x, y, where="post", color=colour, ls=style, lw=2.2, label=name)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.set_xlabel("latency of a frame (µs)")
    axes.set_ylabel("fraction of frames that take longer")
    figure.legend(loc="outside upper center", ncols=2, frameon=False)
    return figure


@styled
def roofline(tables: Tables) -> Figure | None:
    """Draw the sweep's speed and its arithmetic bound, by vector width."""
    rows = [row for row in _rows(tables, "roofline") if {"bound ns", "sweep ns"} <= row.values.keys()]
    if not rows:
        return None
    figure = new_figure(9.0, 1.6 + 0.9 * len(rows))
    axes = figure.add_subplot()
    for place, row in enumerate(reversed(rows)):
        lanes = float(row.name.split("=")[1].split()[0])
        bound, achieved = (lanes / row.values[column] for column in ("bound ns", "sweep ns"))
        names = ("arithmetic bound", "achieved") if place == 0 else (None, None)
        axes.barh(place + 0.2, bound, 0.36, color="#bdbdbd", label=names[0])
        axes.barh(place - 0.2, achieved, 0.36, color=_BLUE, label=names[1])
        axes.annotate(
            f"{achieved / bound:.2f} of the bound",
            (achieved, place - 0.2),
            (6, 0),
            textcoords="offset points",
            va="center",
            fontsize=11,
        )
    axes.set_yticks(range(len(rows)), [row.name for row in reversed(rows)])
    axes.set_ylabel("lanes of a vector")
    axes.set_xlabel("pixels of one sweep per nanosecond, one core")
    axes.margins(x=0.12)
    figure.legend(loc="outside upper center", ncols=2, frameon=False)
    return figure


CAPTIONS: dict[str, tuple[Callable[[Tables], Figure | None], str]] = {
    "rivals": (
        rivals,
        "Median ratio of turns. In brackets: the number of sub-apertures. Black lines: targets. Hatched: "
        "packages that solve another problem.",
    ),
    "scale": (
        scale,
        "Best of all turns. Filled, solid: one core; open, dashed: two. The dotted line is a cost that is "
        "proportional to the number of sub-apertures.",
    ),
    "latency": (
        latency,
        "The steeper a line falls, the shorter the tail. Dashed: frames during which the scheduler "
        "took nothing away.",
    ),
    "roofline": (
        roofline,
        "The bound: how fast this processor can issue the sweep's own arithmetic, if all else cost nothing.",
    ),
}
"""Picture and caption by benchmark."""


def _rows(tables: Tables, name: str) -> list[Row]:
    return tables[name].rows if name in tables else []
