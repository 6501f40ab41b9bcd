"""The pictures of docs/fast.md, drawn from the curves of the tables."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter, NullLocator

from benchmarks.measuring import Table
from faintspot.report.drawing import ARM_COLOURS, GREY, new_figure, png, styled

Curves = Mapping[str, list[tuple[float, float]]]
_TICKS = (3, 4, 6, 8, 10, 15, 20, 30, 40, 60, 100)
_STYLE: dict[str, Any] = {"color": ARM_COLOURS[1], "marker": "o", "ls": "-"}
_FAST = 8


def write_pictures(tables: Mapping[str, Table], folder: Path) -> list[Path]:
    """Draw both pictures; return their paths."""
    figures = {
        "fast_iterations.png": excess(tables["schedules"].curves),
        "fast_infeasible.png": nearly_infeasible(tables["schedules_infeasible"].curves),
    }
    for name, figure in figures.items():
        (folder / name).write_bytes(png(figure))
    return [folder / name for name in figures]


@styled
def excess(curves: Curves) -> Figure:
    """Draw the largest and the median excess of all cells, and how many are above 1 %, by iterations."""
    figure = new_figure(14.0, 4.8)
    panels: tuple[Axes, Axes, Axes] = figure.subplots(1, 3)
    for axes, which in zip(panels, ("worst", "median", "cells"), strict=True):
        _draw(axes, curves[which])
        _iterations(axes)
    panels[0].set_title("worst cell")
    panels[1].set_title("median of all cells")
    panels[2].set_title("cells more than 1 % above")
    for axes in panels[:2]:
        axes.set_ylabel("R above the converged R (%)")
    panels[0].axhline(1.0, color=GREY, lw=1.5, ls=":", label="1 %")
    panels[2].set_ylabel("number of cells")
    panels[2].set_ylim(bottom=0)
    panels[0].set_yscale("log")
    panels[0].set_ylim(bottom=0.8)
    panels[0].set_yticks([1, 2, 5, 10, 20], ["1", "2", "5", "10", "20"])
    panels[0].yaxis.set_minor_formatter(NullFormatter())
    _legend(figure, panels[0])
    return figure


@styled
def nearly_infeasible(curves: Curves) -> Figure:
    """Draw R against iterations where the strength is close to the images' own rms, by kept pixels."""
    labels = [name.split(", ")[-1] for name in curves if name.startswith("converged")]
    figure = new_figure(14.0, 4.8)
    panels = figure.subplots(1, len(labels), sharey=True)
    for axes, label in zip(panels, labels, strict=True):
        _draw(axes, curves[f"R, px, {label}"])
        converged = curves[f"converged: R, px, {label}"][0][1]
        axes.axhline(converged, color="black", lw=1.5, label="converged")
        axes.set_title(label)
        _iterations(axes)
    panels[0].set_ylabel("slope error R (px)")
    _legend(figure, panels[0])
    return figure


def _draw(axes: Axes, points: list[tuple[float, float]]) -> None:
    n, value = np.array(points).T
    axes.plot(n, value, lw=2.2, ms=6, label="so many iterations", **_STYLE)
    ring: dict[str, Any] = {"ls": "", "marker": "o", "ms": 15, "mfc": "none", "mec": ARM_COLOURS[1], "mew": 2}
    axes.plot(n[n == _FAST], value[n == _FAST], label='preset "fast"', **ring)


def _legend(figure: Figure, axes: Axes) -> None:
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), frameon=False)


def _iterations(axes: Axes) -> None:
    axes.set_xscale("log")
    axes.set_xticks(_TICKS, [str(tick) for tick in _TICKS])
    axes.xaxis.set_minor_locator(NullLocator())
    axes.set_xlabel("iterations")
    axes.grid(color="#e4e4e4", lw=0.8)
